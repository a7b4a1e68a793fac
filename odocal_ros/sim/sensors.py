# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Samples of sensors on a true motion.

IMU samples are point samples, not means over the interval: rate and specific force at the stamp;
if the acceleration jumps there, the mean of both sides. A trapezoid rule over the samples of a
route whose kinks lie on them is then exact, a cubic one nearly so. White noise is drawn for the
sample rate, so that integrals have the stated density.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.data import samples
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav import rotations
from odocal_ros.nav.geodesy import radii
from odocal_ros.settings.config import DIFFERENTIAL, HOLONOMIC
from odocal_ros.sim import body, noise, real_sensors, wheels
from odocal_ros.sim.motion import attitude, contact_speed, contact_travel, Motion, State
from odocal_ros.sim.options import REFERENCES, SIM_GRADES, SimOptions
from odocal_ros.sim.real_effects import ZEROS3

FIRST_COUNT = 10_000     # judgement: an encoder that was on before the recording
WHITE_SHARE = 0.2        # judgement: white receiver noise over the sigma of correlated errors
SIGMA_FLOOR = 0.001      # m, judgement: no receiver reports zero
# format: COVARIANCE_TYPE_DIAGONAL_KNOWN and STATUS_GBAS_FIX of sensor_msgs/NavSatFix
DIAGONAL_KNOWN, RTK_STATUS = 2, 2
MOTION_LIMIT = 1e-9      # m/s and rad/s, judgement


def imu_rotation(options: SimOptions) -> Floats:
    """Return C_vi, the rotation from the IMU's own frame to the vehicle: C_vb C_bi."""
    return (rotations.matrix_from_rpy([options.roll, options.pitch, options.yaw])
            @ rotations.matrix_from_rpy(options.mounting_rpy))


def turn_on_biases(options: SimOptions) -> tuple[Floats, Floats]:
    """Return gyro and accelerometer bias at the first sample, frame i: (3,) each."""
    grade, real = SIM_GRADES[options.imu_grade], options.real
    gyro, accel = (
        sigma * noise.make_rng(options.seed, f'{name} bias').standard_normal(3) if value is None
        else np.array(value) for name, sigma, value in (
            ('gyro', grade.gyro_bias, real.gyro_bias),
            ('accelerometer', grade.accel_bias, real.accel_bias)))
    return gyro, accel


def imu_errors(options: SimOptions, n: int) -> tuple[Floats, Floats]:
    """Return gyro and accelerometer errors in frame i, (n, 3) each: noise, bias and its walk."""
    grade, rate, seed = SIM_GRADES[options.imu_grade], options.imu_rate, options.seed
    gyro, accel = turn_on_biases(options)

    def error(name: str, bias: Floats, root_rate: float, root_psd: float) -> Floats:
        walk = noise.random_walk(noise.make_rng(seed, f'{name} walk'), root_rate, rate, (n, 3))
        rng = noise.make_rng(seed, f'{name} white')
        return bias + walk + noise.white(rng, root_psd, rate, (n, 3))
    return (error('gyro', gyro, grade.gyro_bias_walk, grade.gyro_noise),
            error('accelerometer', accel, grade.accel_bias_walk, grade.accel_noise))


def imu(motion: Motion, options: SimOptions) -> samples.ImuSamples:
    """Return the IMU's samples over the whole drive."""
    ns, t = noise.stamps(motion.duration, options.imu_rate)
    state = motion.at(t)
    C_vi = imu_rotation(options)
    w_v, f_v = body.imu_output(motion, state, options.imu_lever_arm)
    w_i, f_i = real_sensors.with_triad_errors(
        w_v @ C_vi * (1 + options.gyro_scale_error), f_v @ C_vi * (1 + options.accel_scale_error),
        options.real)
    gyro, accel = imu_errors(options, len(t))
    gyro_drift, accel_drift = real_sensors.drift_and_vibration(t, state.speed, options)
    q_ni = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    variance = np.full(len(t), np.nan)
    if options.orientation_sigma is not None:
        q_ni = _orientation(state, options, options.orientation_sigma, 'orientation')
        variance = np.full(len(t), options.orientation_sigma**2)
    real = options.real
    if real.imu_latency or real.imu_jitter or real.imu_batch > 1:
        ns = real_sensors.delayed_stamps(ns, noise.make_rng(options.seed, 'real imu stamps'),
                                         real.imu_latency, real.imu_jitter, real.imu_batch)
    stamp = options.start_ns + ns
    return samples.ImuSamples(
        stamp, stamp + noise.TRANSPORT_DELAY_NS['imu'], w_i + gyro + gyro_drift,
        f_i + accel + accel_drift, q_ni, variance)


def heading(motion: Motion, options: SimOptions, sigma: float) -> samples.HeadingSamples:
    """Return an external heading of b's x axis, as from a dual-antenna receiver."""
    ns, t = noise.stamps(motion.duration, options.heading_rate, noise.PHASE['heading'])
    q_nb = _orientation(motion.at(t), replace(options, mounting_rpy=ZEROS3), sigma, 'heading')
    stamp = options.start_ns + ns
    return samples.HeadingSamples(stamp, stamp + noise.TRANSPORT_DELAY_NS['heading'], q_nb,
                                  np.full(len(t), sigma**2))


def pressure(motion: Motion, options: SimOptions) -> samples.ScalarSamples:
    """Return the air pressure, Pa, with weather, wind and warmth; none without a sigma."""
    rate, scale_height, ground = 20.0, 8435.0, 101_325.0    # Hz, m, Pa: standard atmosphere
    sigma = options.pressure_sigma
    if sigma is None:
        return samples.ScalarSamples.empty()
    ns, t = noise.stamps(motion.duration, rate, noise.PHASE['pressure'])
    state, draw = motion.at(t), noise.make_rng(options.seed, 'pressure').standard_normal
    # change by weather, m/s; by wind, m per (m/s)^2; by temperature, relative
    weather, wind, temperature = draw(3) * [1e-3, 6e-3, 0.03]
    height = (state.height + wind * state.speed**2 + weather * t) / (1 + temperature)
    value = ground * np.exp(-(height + sigma * draw(len(t))) / scale_height)
    stamp = options.start_ns + ns
    return samples.ScalarSamples(stamp, stamp, value, (value * sigma / scale_height)**2)


def _orientation(state: State, options: SimOptions, sigma: float, name: str) -> Floats:
    """Return q_ni with a constant heading error, like that of a compass."""
    q_ni = rotations.quat_from_matrix(attitude(state) @ imu_rotation(options))
    error = sigma * noise.make_rng(options.seed, name).standard_normal()
    return rotations.quat_multiply(rotations.quat_from_rotvec([0.0, 0.0, error]), q_ni)


def odometers(motion: Motion, options: SimOptions) -> list[samples.OdometerSamples]:
    """Return the samples of each wheel; pulses are whole counts, rounded down."""
    ns, t = noise.stamps(motion.duration, options.odometer_rate, noise.PHASE['odometer'])
    state = motion.at(t)
    stamp = options.start_ns + _delayed(ns, options, 'odometer')
    lean = motion.lean(t) if motion.lean else 0.0
    return [samples.OdometerSamples(stamp, stamp, _odometer_values(state, options, wheel, lean))
            for wheel in wheels.wheels_of(options)]


def _delayed(ns: Ints, options: SimOptions, name: str) -> Ints:
    """Return stamps, ns, late by delay and jitter of a topic, by a clock with another rate."""
    delay, jitter, rate = (getattr(group, f'{name}_{quantity}') for group, quantity in (
        (options, 'delay'), (options.real, 'jitter'), (options.real, 'clock_rate')))
    ns = ns + np.rint(rate * ns).astype(np.int64)
    if not jitter:
        return np.asarray(ns + round(delay * 1e9))
    rng = noise.make_rng(options.seed, f'real {name} stamps')
    return real_sensors.delayed_stamps(ns, rng, delay, jitter)


def _odometer_values(state: State, options: SimOptions, wheel: wheels.SimWheel,
                     lean: Floats | float) -> Floats | Ints:
    """Return pulses, speeds or angles of a wheel, (n,); lean : of the road, rad."""
    arm, scale, real = wheel.arm, wheel.scale, options.real
    slip_path = slip(state, options, wheel.stream)
    radius_ratio = 1 + wheels.tyre_growth(state, real)      # over that of a cold, slow tyre
    if options.odometer == 'speed':
        rng = noise.make_rng(options.seed, 'speed')
        error = options.speed_noise * rng.standard_normal(len(state.t))
        # current slip: differences of a speed sent twice a second would smooth it
        slip_speed = wheels.slip_share(state, real) * state.speed
        rate = (contact_speed(state, arm, lean) + slip_speed
                + np.gradient(slip_path, state.t)) / radius_ratio
        sent = wheels.low_pass_speed(rate + error, state.t, real.speed_filter)
        return wheels.published_speed(sent / scale, real)
    path = (contact_travel(state, arm, lean) if options.drive == DIFFERENTIAL else
            wheels.robot_path(state, options, wheel))
    rolled = path + slip_path + wheels.tyre_slip(state, real)
    if wheel.steered:
        rolled = rolled + wheels.steered_path(state, arm)
    if np.ndim(radius_ratio):
        mean_ratio = (radius_ratio + np.roll(radius_ratio, 1)) / 2      # of both ends of a step
        rolled = np.cumsum(np.diff(rolled, prepend=rolled[:1]) / mean_ratio)
    rolled = rolled / scale
    # position of the pulse disc at the start, in pulses or radians
    phase = noise.make_rng(options.seed, f'pulse phase {wheel.stream}').uniform()
    if options.odometer == 'angle':
        return rolled + phase
    return FIRST_COUNT + np.floor(rolled + phase).astype(np.int64)


def slip(state: State, options: SimOptions, stream: str = 'L') -> Floats:
    """Return the accumulated slip of a wheel, m, (n,); stream : name of its random numbers."""
    total = np.zeros(len(state.t))
    moving = (np.abs(state.speed) > MOTION_LIMIT) | (np.abs(state.yaw_rate) > MOTION_LIMIT)
    if options.drive in HOLONOMIC:
        moving |= np.abs(state.sway[:, 0]) > MOTION_LIMIT
    steps = np.diff(state.t, prepend=state.t[:1]) * moving
    if options.slip_walk:
        walk = noise.make_rng(options.seed, f'slip walk {stream}')
        total += options.slip_walk * np.cumsum(np.sqrt(steps) * walk.standard_normal(len(total)))
    if options.slip_events:     # each takes a second
        rng = noise.make_rng(options.seed, f'slip events {stream}')
        spins = rng.poisson(options.slip_events * steps.sum() / 3600)
        for begin in rng.choice(state.t[moving], spins):
            total += options.slip_size * np.clip(state.t - begin, 0.0, 1.0)
    if options.start_slip:
        total += options.start_slip * _travel_after_starts(state, moving, options.start_slip_time)
    return total


def _travel_after_starts(state: State, moving: Bools, seconds: float) -> Floats:
    """Return the accumulated travel within ``seconds`` s after each start, m: (n,)."""
    starts = np.flatnonzero(moving & ~np.roll(moving, 1)) - 1    # the last sample at rest
    starts = starts[starts >= 0]
    if not len(starts):
        return np.zeros(len(moving))
    latest = np.searchsorted(starts, np.arange(len(moving)), side='right') - 1    # start up to now
    is_near = (latest >= 0) & (state.t - state.t[starts[latest]] <= seconds + 1e-6)  # s, rounding
    return np.cumsum(np.diff(state.travel, prepend=state.travel[:1]) * is_near)


def fixes(motion: Motion, options: SimOptions) -> samples.FixSamples:
    """Return GNSS fixes of the antenna, without those in an outage."""
    ns, t = noise.stamps(motion.duration, options.fix_rate, noise.PHASE['fix'])
    latitude, longitude, height = real_sensors.positions(motion, t, options)
    error = fix_errors(t, options) + real_sensors.position_errors(t, options)
    error = error + noise.reference_drift(t, motion.at(t).travel, options)
    error = real_sensors.fused_errors(t, error, options)
    meridian, normal = radii(latitude)
    metres_per_rad = np.stack([(normal + height) * np.cos(latitude), meridian + height], -1)
    # from the first fix; metres per radian change along the path
    change = np.stack([longitude - longitude[:1], latitude - latitude[:1]], -1)
    position = np.column_stack([metres_per_rad * change, height])
    error = real_sensors.tunnel_errors(t, error, position, options)
    latitude = latitude + error[:, 1] / (meridian + height)
    longitude = longitude + error[:, 0] / ((normal + height) * np.cos(latitude))
    n = len(t)
    stamp = options.start_ns + _delayed(ns, options, 'fix')
    sent = samples.FixSamples(
        stamp, stamp + noise.TRANSPORT_DELAY_NS['fix'], latitude, longitude, height + error[:, 2],
        np.tile(np.diag(_stated_variances(options)), (n, 1, 1)), np.full(n, DIAGONAL_KNOWN),
        np.full(n, RTK_STATUS if options.fix_noise == 'rtk' else 0))
    received = np.ones(n, dtype=bool)
    for begin, end in options.outages:
        received &= (t < begin) | (t >= end)
    if options.real.drops:
        draws = noise.make_rng(options.seed, 'real drops').uniform(size=n)
        received &= draws >= options.real.drops
    return samples.take(sent, received)


def _stated_variances(options: SimOptions) -> Floats:
    """Return the variances that the receiver states, east, north and up, m^2: without bursts."""
    real = options.real
    variance_ratio = 1 + WHITE_SHARE**2 if options.fix_noise == 'correlated' else 1.0
    slow_variance = sum(sigma**2 for sigma, _ in real.slow_errors)
    variance = (_axis_sigmas(options) ** 2 * variance_ratio + noise.stationary_sigma(options)**2
                + slow_variance * np.array([1.0, 1.0, real_sensors.UP_RATIO**2]))
    variance = np.maximum(variance * real.stated_sigma_ratio**2, SIGMA_FLOOR**2)
    if REFERENCES[options.reference].is_planar:
        variance[2] = 0.0
    return variance


def _axis_sigmas(options: SimOptions) -> Floats:
    """Return the sigmas of fixes east, north and up, m."""
    return options.fix_sigma * np.array([1.0, 1.0, 2.0])


def fix_errors(t: Floats, options: SimOptions) -> Floats:
    """Return the errors of fixes at (n,) times, ENU, m: (n, 3), outliers included."""
    draws = noise.make_rng(options.seed, 'fix white').standard_normal((len(t), 3))
    if options.fix_noise == 'correlated':
        slow = noise.gauss_markov(noise.make_rng(options.seed, 'fix slow'), 1.0,
                                  options.fix_correlation_time, t)
        draws = slow + WHITE_SHARE * draws
    errors = _axis_sigmas(options) * draws
    rng = noise.make_rng(options.seed, 'outliers')
    is_outlier = rng.uniform(size=len(t)) < options.outliers
    direction = rng.uniform(0, 2 * np.pi, len(t))
    distance = options.outlier_size * rng.uniform(0.5, 1.5, len(t)) * is_outlier
    errors[:, :2] += (distance * [np.cos(direction), np.sin(direction)]).T
    return errors
