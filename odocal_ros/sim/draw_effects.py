# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Draw the effects of a simulated vehicle: of IMU, wheels, body and receiver (docs/zoo.md).

Each function draws one effect from a random generator and returns the values that cause it. The
functions are in EFFECTS and RARE, by the name that ``odocal simulate --effect`` accepts.
"""

from collections.abc import Callable
import math

import numpy as np

from odocal_ros.settings.nominal import GRADES
from odocal_ros.sim.vehicle_distributions import DEG, Effect, flat, G, KMH, lognormal, MG, Vehicle

# judgement: turn-on bias of the accelerometer's axes over that of the grade (docs/zoo.md)
AXIS_RATIOS = [1, 1, 1.3]


def triads(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw scale and misalignment of each axis, and a rotation between gyro and accelerometer."""
    x, y, z = rng.normal(0.0, vehicle.grade_value('triad rotation') / math.sqrt(2), 3)
    # each triad has half of the variance of the rotation
    rotation = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    real = {}
    for name, sensor, sign in (('gyro_matrix', 'gyro', 1), ('accel_matrix', 'accelerometer', -1)):
        misalignment = rng.normal(0.0, vehicle.grade_value('misalignment'), (3, 3))
        M = misalignment + sign * rotation / math.sqrt(2)
        # a data sheet limits it to three sigmas
        np.fill_diagonal(M, vehicle.grade_value(f'{sensor} scale')
                         * np.clip(rng.standard_normal(3), -3.0, 3.0))
        real[name] = flat(M)
    return Effect(real=real)


def g_sensitivity(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw the sensitivity of each gyro to specific force along each axis."""
    sigma = vehicle.grade_value('g sensitivity')
    return Effect(real={'g_sensitivity': flat(rng.normal(0.0, sigma, 9))})


def bias(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw turn-on biases by the vehicle's class, and their drift during the run."""
    return Effect(real={
        'gyro_bias': flat(rng.normal(0.0, vehicle.grade_value('gyro bias'), 3)),
        'accel_bias': flat(
            rng.normal(0.0, vehicle.grade_value('accelerometer bias'), 3) * AXIS_RATIOS),
        'gyro_instability': vehicle.grade_value('gyro instability'),
        'accel_instability': vehicle.grade_value('accelerometer instability')})


def temperature(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw biases that change while the IMU warms up; it may have been on for some minutes."""
    tau = lognormal(rng, 300.0, 0.5)
    time_on = rng.uniform(0.0, 600.0)
    real = {}
    for name, sensor in (('gyro_slope', 'gyro'), ('accel_slope', 'accelerometer')):
        median, log_sigma = vehicle.grade_value(f'{sensor} slope')
        sign = rng.choice([-1, 1], 3)
        real[name] = flat(sign * (median * np.exp(log_sigma * rng.standard_normal(3))))
    lowest, highest = vehicle.grade_value('temperature rise')
    rise = rng.uniform(lowest, highest) * math.exp(-time_on / tau)
    return Effect(real=real | {'warm_rise': float(rise), 'warm_time': tau})


def vibration(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw the vibration of the IMU by road and engine."""
    rms = G * rng.uniform(0.02, 0.1)
    return Effect(real={
        'vibration': float(rms), 'gyro_vibration': float(DEG * rng.uniform(0.1, 0.5)),
        'rectification': float(vehicle.grade_value('rectification') * rng.choice([-1, 1]))})


def imu_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Delay stamps by filter and transport, with jitter, in batches."""
    shortest, longest = vehicle.grade_value('imu filter delay')
    latency = rng.uniform(shortest, longest) + lognormal(
        rng, *vehicle.grade_value('stamp latency'))
    batches = vehicle.grade == 'industrial' and rng.uniform() < 0.3
    return Effect(real={
        'imu_latency': float(latency), 'imu_jitter': vehicle.grade_value('imu jitter'),
        'imu_batch': 2 if batches else 1})


def grade(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Configure the true grade, or one better or worse, between consumer and navigation."""
    names = list(GRADES)
    stated = names.index(vehicle.grade) + int(rng.integers(-1, 2))
    configured_grade = names[max(0, min(stated, len(names) - 1))]
    return Effect() if configured_grade == vehicle.grade else Effect(
        real={'configured_grade': configured_grade})


def coarse_speed(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Quantise speeds as a vehicle bus does, with a dead band; in 3 of 10 to whole km/h."""
    whole_kmh = vehicle.effects_certain or rng.uniform() < 0.3      # as in OBD-II
    resolutions = (0.0075, 0.01, 0.031, 0.056, 0.06)     # km/h, of vehicle buses
    real = {'speed_step': KMH * (1.0 if whole_kmh else float(rng.choice(resolutions))),
            'speed_rounding': str(rng.choice(['floor', 'round']))}
    draw = rng.uniform()      # of ten vehicles three have no dead band, two a large one
    band_kmh = 0.0 if draw < 0.3 else rng.uniform(0.3, 1) if draw < 0.8 else rng.uniform(1, 3.5)
    rate = float(rng.choice([1.0, 2.0, 5.0, 10.0] if whole_kmh else [10.0, 20.0, 50.0]))
    return Effect(real=real | {'dead_band': 0.0 if whole_kmh else band_kmh * KMH},
                  options=vehicle.speed_options | {'odometer_rate': rate})


def coarse_pulses(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Count few pulses per metre: the teeth of a brake's tone wheel."""
    nominal = 1 / rng.uniform(15, 50)
    return Effect(options={'scale': vehicle.speed_options['scale'] * nominal,
                          'nominal_scale': float(nominal)})


def odometer_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Delay stamps by filter and bus, with jitter."""
    delay = lognormal(rng, *((0.015, 0.6) if vehicle.robot else (0.04, 0.5)
                             if vehicle.grade != 'tactical' else (0.005, 0.3)))
    return Effect(real={'odometer_jitter': 0.003}, options={'odometer_delay': delay})


def warming(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Let tyres grow as they warm up."""
    factor = 0.5 if vehicle.grade == 'tactical' else 1.0
    return Effect(real={'warming': float(factor * rng.uniform(0.001, 0.004)),
                        'warming_time': lognormal(rng, 600.0, 0.4)})


def sideslip(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Let the rear axle drift outwards by the lateral acceleration."""
    drift = rng.uniform(0, 0.1) if vehicle.robot else lognormal(rng, 0.22, 0.35)
    return Effect(real={'sideslip': float(drift * DEG)})


def squat(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Let the body pitch and roll on its springs."""
    pitch, roll = (0.2, 0.5) if vehicle.robot else (lognormal(rng, 1.3, 0.4),
                                                    lognormal(rng, 4.5, 0.3))
    return Effect(real={'squat': float(pitch * DEG / G), 'body_roll': float(roll * DEG / G)})


def lever_arms(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw errors of lever arms: measured with a tape, by eye, or left at zero."""
    is_unmeasured, real = rng.uniform() < vehicle.grade_value('unmeasured lever arms'), {}
    for name in ('imu', 'antenna', 'odometer'):
        error = vehicle.grade_value('lever arm error') * rng.standard_normal(3)
        arm = np.array(vehicle.options[f'{name}_lever_arm'])
        real[f'{name}_arm_error'] = flat(-arm if is_unmeasured else error)
    return Effect(real=real)


def fix_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Stamp fixes at their arrival, as half of the drivers do."""
    if vehicle.grade == 'tactical' or not (vehicle.effects_certain or rng.uniform() < 0.5):
        return Effect()
    return Effect(real={'fix_jitter': 0.01}, options={'fix_delay': lognormal(rng, 0.12, 0.4)})


def slow_errors(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw time-correlated errors of fixes, most of one minute, the rest of 15 minutes."""
    if vehicle.rtk:
        return Effect(real={'slow_errors': ((0.01, 100.0),)}, options={'fix_sigma': 0.008})
    sbas_factor = 0.6 if rng.uniform() < 0.4 else 1.0
    sigma = sbas_factor * lognormal(rng, 1.5, 0.4)
    return Effect(real={'slow_errors': ((sigma * 0.6**0.5, 60.0), (sigma * 0.4**0.5, 900.0))},
                  options={'fix_sigma': float(rng.uniform(0.02, 0.3))})


def multipath(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw bursts of wrong positions in a city; with RTK, occasional wrong fixes."""
    if vehicle.rtk:
        return Effect(real={'bursts': 12.0 if vehicle.city else 1.0, 'burst_size': 0.6,
                            'burst_time': 60.0})
    if not (vehicle.city or vehicle.effects_certain):
        return Effect()
    return Effect(real={'bursts': 40.0, 'burst_size': 12.0, 'burst_time': 8.0})


def covariance(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """State sigmas that are not the true ones; in a city most are too small."""
    optimism = lognormal(rng, *((3.0, 0.7) if vehicle.city and not vehicle.rtk else (1.3, 0.5)))
    return Effect(real={'stated_sigma_ratio': 1 / optimism})


def outages(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Draw outages, and a loss of one fix in a hundred."""
    spans = []
    for _ in range(int(rng.poisson(3.0 if vehicle.city else 1.0)) + vehicle.effects_certain):
        begin = float(rng.uniform(30.0, 500.0))
        spans.append((begin, begin + min(lognormal(rng, 10.0, 1.0), 90.0)))
    return Effect(real={'drops': 0.01}, options={'outages': tuple(sorted(spans))})


def clocks(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Stamp odometer and fixes by clocks with other rates than that of the IMU."""
    odometer, fix = rng.uniform(2e-5, 1e-4, 2) * rng.choice((-1, 1), 2)
    return Effect(real={'odometer_clock_rate': float(odometer), 'fix_clock_rate': float(fix)})


def tunnels(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Dead-reckon in the receiver through tunnels, by its internal odometer and gyro."""
    begins = rng.uniform((60.0, 300.0), (200.0, 420.0))
    return Effect(real={
        'tunnels': tuple((float(b), float(rng.uniform(20.0, 120.0))) for b in begins),
        'tunnel_odometer': float(rng.uniform(0.005, 0.02) * rng.choice((-1, 1))),
        'tunnel_heading': float(DEG * rng.normal())})


def kerbs(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Drive on ground with cross slopes; in a yard over kerbs too."""
    slopes = {'alternating_crossfall': float(DEG * rng.uniform(1.0, 2.0))}
    if vehicle.kind != 'yard':
        return Effect(real=slopes | {'alternating_crossfall_length': 200.0, 'wheelbase': 2.7})
    return Effect(real=slopes | {'kerbs': float(rng.uniform(0.04, 0.08)), 'wheelbase': 0.5})


def bias_steps(rng: np.random.Generator, vehicle: Vehicle) -> Effect:
    """Change the biases at a time in mid-drive: a knock, a strained board, another supply."""
    accel, gyro = rng.normal(size=(2, 3))
    return Effect(real={
        'accel_step': flat(accel * MG * rng.uniform(1.0, 20.0) / np.linalg.norm(accel)),
        'gyro_step': flat(gyro * DEG * rng.uniform(0.01, 0.2) / np.linalg.norm(gyro)),
        'bias_step_at': float(rng.uniform(100.0, 300.0))})


Draw = Callable[[np.random.Generator, Vehicle], Effect]
EFFECTS: dict[str, Draw] = {draw.__name__: draw for draw in (
    triads, g_sensitivity, bias, temperature, vibration, imu_stamps, grade, coarse_speed,
    coarse_pulses, odometer_stamps, warming, sideslip, squat, lever_arms, fix_stamps, slow_errors,
    multipath, covariance, outages)} | {
    # tyres grow with the square of the speed
    'speed_law': lambda rng, _: Effect(real={'speed_law': lognormal(rng, 0.002, 0.6)}),
    # tyres slip under traction and braking
    'slip': lambda rng, _: Effect(real={'tyre_slip': 1 / lognormal(rng, 30.0, 0.4),
                                        'driven': bool(rng.uniform() < 0.5)}),
    # receivers filter positions
    'receiver_lag': lambda rng, _: Effect(real={'receiver_lag': float(rng.uniform(0.01, 0.15))})}
# only with --effect NAME: receivers and buses of some vehicles
RARE: dict[str, Draw] = {draw.__name__: draw for draw in (tunnels, kerbs, clocks, bias_steps)} | {
    # an uncalibrated odometer is fused into the fixes, as in car head units
    'fused_fixes': lambda rng, _: Effect(real={
        'receiver_odometer': float(rng.uniform(0.003, 0.02) * rng.choice((-1, 1))),
        'receiver_odometer_time': lognormal(rng, 20.0, 0.5)}),
    # receivers in vehicle mode filter position and velocity
    'tracked_fixes': lambda rng, _: Effect(real={
        'receiver_tracking': float(rng.uniform(0.3, 1.0))}),
    # a published speed is held until it has changed by a step, as on many buses
    'held_speed': lambda rng, vehicle: Effect(
        real={'speed_hold': KMH * float(rng.choice((0.2, 0.5)))}, options=vehicle.speed_options),
    # speeds have passed a low pass, like most speed signals of cars
    'filtered_speed': lambda rng, vehicle: Effect(
        real={'speed_filter': float(rng.uniform(0.2, 0.6))},
        options=vehicle.speed_options | {'odometer_rate': 20.0}),
    # fixes are stamped at reception, after a latency that varies
    'late_fixes': lambda rng, _: Effect(real={'fix_jitter': float(rng.uniform(0.05, 0.1))},
                                        options={'fix_delay': 0.25}),
    # near a wall the receiver has only reflections for half a minute, with slow onset and end
    'reflections': lambda rng, _: Effect(real={'bursts': 20.0, 'burst_size': 12.0,
                                               'burst_time': 30.0, 'burst_onset': 10.0})}
