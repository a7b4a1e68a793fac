# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Errors of a real IMU and receiver, with the sizes in ``SimOptions.real``, for sensors.py.

IMU: axes that are not orthogonal, vibration, drift, late stamps. Receiver: filters, an odometer in
it, multipath, tunnels; and its published velocity.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import VelocitySamples
from odocal_ros.nav.geodesy import radii
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.sim import body
from odocal_ros.sim.motion import Motion, point_geodetic
from odocal_ros.sim.noise import gauss_markov, make_rng, PHASE, stamps, TRANSPORT_DELAY_NS
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects

# physical: frequency, Hz, width, Hz, and relative power of wheel hop and of the engine
RESONANCES = ((12.0, 3.0, 1.0), (27.0, 4.0, 0.6))
MIN_GAP_NS = 50_000    # judgement: between the stamps of one batch
# definition: a filter gives a weighted mean of past positions. AGES of these, in time constants,
# are the nodes of two-point Gauss rules on the intervals between AGE_EDGES, which are short enough
# for the corners of a route; AGE_LENGTHS: half of the length of the interval of each
AGE_EDGES = np.concatenate([np.arange(0.0, 8.0, 0.25), np.arange(8.0, 20.0, 1.0),
                            np.arange(20.0, 41.0, 4.0)])
AGES = (AGE_EDGES[:-1, None] + np.diff(AGE_EDGES)[:, None] * (
    0.5 + np.array([-1, 1]) / 12**0.5)).ravel()
AGE_LENGTHS = np.repeat(np.diff(AGE_EDGES) / 2, 2)
# definition: weights of a first-order filter, and of a second-order filter of position and
# velocity, damped by sqrt(1/2)
FIRST_ORDER, SECOND_ORDER = (weights / weights.sum() for weights in (
    np.exp(-AGES) * AGE_LENGTHS, np.exp(-AGES / 2**0.5) * np.cos(AGES / 2**0.5) * AGE_LENGTHS))
UP_RATIO = 2.0       # judgement: height errors over those of east and north
# judgement: range of the rise and fall times of bursts, over their mean
ONSET_RANGE = (0.5, 1.5)
HALF_STEP = 0.005       # s, judgement: differences of positions are exact to 1e-4 m/s
OUTLIER_SIGMA = 5.0     # m/s, judgement: a wrong Doppler in a street


def forward_angles(d: Floats) -> tuple[float, float]:
    """Return yaw and pitch mounting angle, rad, for the forward axis of the vehicle in b, (3,)."""
    return float(-np.arcsin(d[1])), float(np.arctan2(d[2], d[0]))


def sensor_axes(gyro_matrix: Floats, accel_matrix: Floats) -> Floats:
    """
    Return the rotation to the frame of the matrices from that of the sensor axes, (3, 3).

    The sensors measure ``I + M`` times a vector. Their axes are defined by the measurements: z is
    the axis of a turn that only the z gyro measures, x is perpendicular to it, in the direction of
    a force that the y accelerometer does not measure. To first order the rotation is
    ``I + [theta x]`` with theta = (M_g,yz, -M_g,xz, -M_a,yx).
    """
    gyro, accel = np.eye(3) + gyro_matrix, np.eye(3) + accel_matrix
    z = np.linalg.solve(gyro, [0.0, 0.0, 1.0])
    z /= np.linalg.norm(z)
    x = np.cross(accel[1], z)      # perpendicular to the y accelerometer and to z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], -1)


def mounting_angles(options: SimOptions) -> dict[str, float]:
    """Return yaw and pitch of the sensor axes and of the housing, rad, as fields of ``Truth``."""
    gyro, accel = options.real.matrix('gyro_matrix'), options.real.matrix('accel_matrix')
    yaw, pitch = yaw_housing, pitch_housing = options.yaw, options.pitch
    if options.roll or gyro.any() or accel.any():
        # with a roll the angles are those of forward: docs/conventions.md
        d = matrix_from_rpy([options.roll, options.pitch, options.yaw])[0]
        C_bi = matrix_from_rpy(options.mounting_rpy)
        axes = sensor_axes(C_bi @ gyro @ C_bi.T, C_bi @ accel @ C_bi.T)
        (yaw, pitch), (yaw_housing, pitch_housing) = forward_angles(axes.T @ d), forward_angles(d)
    return {'yaw': yaw, 'pitch': pitch, 'yaw_housing': yaw_housing,
            'pitch_housing': pitch_housing}


def with_triad_errors(w_i: Floats, f_i: Floats, real: RealEffects) -> tuple[Floats, Floats]:
    """Return turn rate and specific force with the errors of the triads: (n, 3) each."""
    gyro, accel, G = (real.matrix(n) for n in ('gyro_matrix', 'accel_matrix', 'g_sensitivity'))
    w_m = w_i + w_i @ gyro.T if gyro.any() else w_i
    if G.any():
        w_m = w_m + f_i @ G.T
    return w_m, f_i + f_i @ accel.T if accel.any() else f_i


def drift_and_vibration(t: Floats, speed: Floats, options: SimOptions) -> list[Floats | float]:
    """Return gyro and accelerometer errors beyond noise and turn-on bias: (n, 3) or 0.0 each."""
    real = options.real
    warmth = real.warm_rise * -np.expm1(-t / real.warm_time)[:, None]
    by_sensor = []
    for name, rms in (('gyro', real.gyro_vibration), ('accel', real.vibration)):
        slope, sigma = getattr(real, f'{name}_slope'), getattr(real, f'{name}_instability')
        total = warmth * np.array(slope) if real.warm_rise and any(slope) else 0.0
        if any(step := getattr(real, f'{name}_step')):
            total = total + (t >= real.bias_step_at)[:, None] * np.array(step)
        if sigma:      # the key of the random numbers must not change
            total = total + _instability(make_rng(options.seed, f'real {name} wander'), sigma,
                                         real.instability_time, t)
        if rms:
            share = np.abs(speed)[:, None] / (np.abs(speed)[:, None] + 5.0)    # half at 5 m/s
            total = total + share * vibration(make_rng(options.seed, f'real {name} vibration'),
                                              rms, options.imu_rate, len(t))
            if name == 'accel' and real.rectification:
                total = total + real.rectification * (rms * share)**2
        by_sensor.append(total)
    return by_sensor


def _instability(rng: np.random.Generator, sigma: float, tau: float, t: Floats) -> Floats:
    """Return a Gauss-Markov process that starts at 0, linear between draws."""
    knots = np.arange(0.0, t[-1] + 2.0, 1.0)    # s
    x = gauss_markov(rng, sigma, tau, knots)
    return np.stack([np.interp(t, knots, column) for column in (x - x[0]).T], -1)


def vibration(rng: np.random.Generator, rms: float, rate: float, n: int) -> Floats:
    """Return accelerations of a vibrating body, (n, 3): around its resonances, zero at 0 Hz."""
    f = np.fft.rfftfreq(n, 1 / rate)
    power = np.zeros_like(f)
    for middle, width, share in RESONANCES:
        peak = min(middle, 0.4 * rate)
        power += share * np.minimum(f / peak, 1.0)**4 / (1 + ((f - peak) / width)**2)
    shape = np.sqrt(power)[:, None]
    x = np.fft.irfft(np.fft.rfft(rng.standard_normal((n, 3)), axis=0) * shape, n, axis=0)
    # both halves of the spectrum: the mean square of the shape is that of the samples
    weight = np.full(len(f), 2.0)
    weight[0] = 1.0
    weight[-1] = 1.0 if n % 2 == 0 else 2.0
    return np.asarray(rms * x / np.sqrt((weight * power).sum() / n))


def delayed_stamps(ns: Ints, rng: np.random.Generator, latency: float, jitter: float,
                   batch: int = 1) -> Ints:
    """Return stamps, ns, of samples at ``ns``: late (none early), in order, in batches."""
    delay = np.maximum(latency + jitter * rng.standard_normal(len(ns)), 0.0)
    stamp = ns + np.rint(delay * 1e9).astype(np.int64)
    offsets_ns = MIN_GAP_NS * np.arange(len(ns))
    if batch > 1:
        last = np.minimum(np.arange(len(ns)) // batch * batch + batch - 1, len(ns) - 1)
        stamp = stamp[last]
    return np.maximum.accumulate(stamp - offsets_ns) + offsets_ns


def positions(motion: Motion, t: Floats, options: SimOptions) -> tuple[Floats, Floats, Floats]:
    """
    Return latitude, longitude (rad), height (m) of a receiver without noise at t.

    An odometer in the receiver with a scale error adds this share of the path that satellites have
    not yet corrected: from the filtered position to the true one.
    """
    real, true = options.real, _antenna(motion, t, options)
    position = true
    if real.receiver_lag:
        position = _filter_positions(motion, t, options, FIRST_ORDER, real.receiver_lag)
    if real.receiver_tracking:
        position = _filter_positions(motion, t, options, SECOND_ORDER, real.receiver_tracking)
    if real.receiver_odometer:
        corrected = _filter_positions(motion, t, options, FIRST_ORDER, real.receiver_odometer_time)
        latitude, longitude, height = (
            x + real.receiver_odometer * (x_true - x_corrected)
            for x, x_true, x_corrected in zip(position, true, corrected, strict=True))
        return latitude, longitude, height
    return position


def _filter_positions(motion: Motion, t: Floats, options: SimOptions, weights: Floats,
                      tau: float) -> tuple[Floats, Floats, Floats]:
    """Return filtered positions; weights : of AGES.   tau : time constant, s."""
    past = [_antenna(motion, np.maximum(t - tau * age, 0.0), options) for age in AGES]
    latitude, longitude, height = (
        sum(w * x for w, x in zip(weights, coordinate, strict=True))
        for coordinate in zip(*past, strict=True))
    return latitude, longitude, height


def fused_errors(t: Floats, errors: Floats, options: SimOptions) -> Floats:
    """Return satellite errors, (n, 3) m, low-pass filtered by a receiver with an odometer."""
    if not options.real.receiver_odometer:
        return errors
    decay = np.exp(-np.diff(t) / options.real.receiver_odometer_time)
    out = errors.copy()
    for k, a in enumerate(decay, 1):
        out[k] = a * out[k - 1] + (1 - a) * errors[k]
    return out


def _antenna(motion: Motion, t: Floats, options: SimOptions) -> tuple[Floats, Floats, Floats]:
    """Return the true latitude and longitude, rad, and height, m, of the antenna at times t."""
    tilt = body.rotation(motion, t) if motion.tilt else None
    return point_geodetic(motion.at(t), options.antenna_lever_arm, tilt)


def position_errors(t: Floats, options: SimOptions) -> Floats | float:
    """Return slow errors and bursts of the fixes at (n,) times, ENU: (n, 3) m, or 0.0."""
    real = options.real
    total: Floats | float = 0.0
    for k, (sigma, tau) in enumerate(real.slow_errors):
        errors = gauss_markov(make_rng(options.seed, f'real slow {k}'), sigma, tau, t)
        total = total + errors * [1.0, 1.0, UP_RATIO]
    return total + burst_errors(t, options) if real.bursts else total


def burst_errors(t: Floats, options: SimOptions) -> Floats:
    """Return errors by multipath, (n, 3) m: bursts in random directions, with smooth edges."""
    real, rng = options.real, make_rng(options.seed, 'real bursts')
    total, hours = np.zeros((len(t), 3)), t[-1] / 3600
    for _ in range(rng.poisson(real.bursts * hours)):
        begin, azimuth = rng.uniform(0.0, t[-1]), rng.uniform(0, 2 * np.pi)
        size, length = (median * np.exp(real.burst_spread * rng.standard_normal())
                        for median in (real.burst_size, real.burst_time))
        onset, up = real.burst_onset * rng.uniform(*ONSET_RANGE), rng.normal()
        x = np.clip(np.minimum(t - begin, begin + length + onset - t) / onset, 0.0, 1.0)
        shape = size * x**2 * (3 - 2 * x)
        total += shape[:, None] * [np.cos(azimuth), np.sin(azimuth), up]
    return total


def tunnel_errors(t: Floats, error: Floats, position: Floats, options: SimOptions) -> Floats:
    """Return (n, 3) m errors of a receiver that dead-reckons in tunnels from the entry."""
    real, out = options.real, error.copy()
    for begin, length in real.tunnels:
        inside = np.flatnonzero((t >= begin) & (t < begin + length))
        if len(inside) < 2:
            continue
        steps = np.diff(position[inside], axis=0, prepend=position[inside[:1]])
        heading_error = real.tunnel_heading * (t[inside, None] - begin) / 60
        steps_left = np.stack([-steps[:, 1], steps[:, 0], 0 * steps[:, 2]], -1)
        out[inside] = error[inside[0]] + np.cumsum(
            real.tunnel_odometer * steps + heading_error * steps_left, axis=0)
    return out


def velocity(motion: Motion, options: SimOptions) -> VelocitySamples:
    """Return the published velocity of the antenna; none without a sigma."""
    sigma = options.velocity_sigma
    if sigma is None:
        return VelocitySamples.empty()
    ns, t = stamps(motion.duration, options.velocity_rate, PHASE['fix'])
    # the velocity is the derivative of positions with its own filter
    filtered = replace(options, real=replace(options.real, receiver_lag=options.velocity_lag))
    before, after = (np.stack(positions(motion, np.maximum(t + dt, 0.0), filtered), -1)
                     for dt in (-HALF_STEP, HALF_STEP))
    latitude, _, height = after.T
    meridian, normal = radii(latitude)
    north, east, up = ((after - before) / (2 * HALF_STEP)).T
    true = np.stack([east * (normal + height) * np.cos(latitude), north * (meridian + height), up],
                    -1)
    tau, rng = options.velocity_correlation_time, make_rng(options.seed, 'velocity')
    error = (gauss_markov(rng, sigma, tau, t) if tau
             else sigma * rng.standard_normal((len(t), 3)))
    is_outlier = rng.uniform(size=(len(t), 1)) < options.velocity_outliers
    published = true * (1 + options.velocity_scale_error) + (
        error + is_outlier * OUTLIER_SIGMA * rng.standard_normal((len(t), 3)))
    stamp = options.start_ns + ns + round(options.velocity_delay * 1e9)
    return VelocitySamples(stamp, stamp + TRANSPORT_DELAY_NS['fix'], published,
                           np.full(published.shape, sigma**2))
