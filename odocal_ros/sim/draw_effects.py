# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Effects of a drawn vehicle, after the tables of docs/zoo.md: IMU, wheels, body, receiver.

Each function draws one effect. ``Drawn`` holds figures of the real vehicle (`sim/real.py`) and
options of the simulation (`sim/options.py`). ``vehicle.size`` and ``vehicle.row`` are one figure
and a pair of figures from the tables, by the class of the vehicle; ``vehicle.alone`` is True if
the effect is requested alone and must be present.
"""

import math

import numpy as np

from odocal_ros.settings.nominal import GRADES
from odocal_ros.sim.zoo import DEG, Drawn, flat, G, KMH, lognormal, MG, Vehicle


def triads(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw scale and misalignment of each axis, and a rotation between gyro and accelerometer."""
    x, y, z = rng.normal(0.0, vehicle.size('between') / math.sqrt(2), 3)
    # the rotation, of size 'between', is split: half of its variance to each triad
    rotation = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    figures = {}
    for name, sensor, sign in (('gyro_matrix', 'gyro', 1), ('accel_matrix', 'accelerometer', -1)):
        M = rng.normal(0.0, vehicle.size('cross'), (3, 3)) + sign * rotation / math.sqrt(2)
        # a data sheet limits it to three sigmas
        np.fill_diagonal(M, vehicle.size(f'{sensor} scale')
                         * np.clip(rng.standard_normal(3), -3.0, 3.0))
        figures[name] = flat(M)
    return Drawn(figures)


def g_sensitivity(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw the sensitivity of each gyro to specific force along each axis."""
    return Drawn({'g_sensitivity': flat(rng.normal(0.0, vehicle.size('g sensitivity'), 9))})


def bias(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw turn-on biases by the vehicle's class, and their drift during the run."""
    return Drawn({
        'gyro_bias': flat(rng.normal(0.0, vehicle.size('gyro bias'), 3)),
        'accel_bias': flat(rng.normal(0.0, vehicle.size('accelerometer bias'), 3) * [1, 1, 1.3]),
        'gyro_wander': vehicle.size('gyro wander'),
        'accel_wander': vehicle.size('accelerometer wander')})


def temperature(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw biases that change while the IMU warms up; it may have been on for some minutes."""
    tau = lognormal(rng, 300.0, 0.5)
    time_on = rng.uniform(0.0, 600.0)
    figures = {}
    for name, sensor in (('gyro_slope', 'gyro'), ('accel_slope', 'accelerometer')):
        median, spread = vehicle.row(f'{sensor} slope')
        sign = rng.choice([-1, 1], 3)
        figures[name] = flat(sign * (median * np.exp(spread * rng.standard_normal(3))))
    least, most = vehicle.row('warmth')
    rise = rng.uniform(least, most) * math.exp(-time_on / tau)
    return Drawn(figures | {'warm_rise': float(rise), 'warm_time': tau})


def vibration(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw the vibration of the IMU by road and engine."""
    rms = G * rng.uniform(0.02, 0.1)
    return Drawn({'vibration': float(rms), 'gyro_vibration': float(DEG * rng.uniform(0.1, 0.5)),
                  'rectification': float(vehicle.size('rectified') * rng.choice([-1, 1]))})


def imu_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Delay stamps by filter and transport, with jitter, in batches."""
    shortest, longest = vehicle.row('filter')
    latency = rng.uniform(shortest, longest) + lognormal(rng, *vehicle.row('latency'))
    batches = vehicle.grade == 'industrial' and rng.uniform() < 0.3
    return Drawn({'imu_latency': float(latency), 'imu_jitter': vehicle.size('imu jitter'),
                  'imu_batch': 2 if batches else 1})


def grade(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Set ``imu.grade`` to the true one, or one better or worse (at most navigation, consumer)."""
    names = list(GRADES)
    stated = names.index(vehicle.grade) + int(rng.integers(-1, 2))
    configured_grade = names[max(0, min(stated, len(names) - 1))]
    return Drawn({} if configured_grade == vehicle.grade else
                 {'configured_grade': configured_grade})


def coarse_speed(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Quantise speeds as a vehicle bus, with a dead band; at times whole km/h at 1 to 10 Hz."""
    whole = vehicle.alone or rng.uniform() < 0.3      # as in OBD-II
    resolutions = (0.0075, 0.01, 0.031, 0.056, 0.06)     # km/h, of vehicle buses
    real = {'speed_step': KMH * (1.0 if whole else float(rng.choice(resolutions))),
            'speed_rounding': str(rng.choice(['floor', 'round']))}
    chance = rng.uniform()
    band = (0.0 if chance < 0.3 else rng.uniform(0.3, 1) if chance < 0.8 else rng.uniform(1, 3.5))
    rate = float(rng.choice([1.0, 2.0, 5.0, 10.0] if whole else [10.0, 20.0, 50.0]))
    return Drawn(real | {'dead_band': 0.0 if whole else band * KMH},
                 vehicle.speed_options | {'odometer_rate': rate})


def coarse_pulses(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Count few pulses per metre: the teeth of a brake's tone wheel."""
    nominal = 1 / rng.uniform(15, 50)
    return Drawn(options={'scale': vehicle.speed_options['scale'] * nominal,
                          'nominal_scale': float(nominal)})


def odometer_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Delay stamps by filter and bus, with jitter."""
    delay = lognormal(rng, *((0.015, 0.6) if vehicle.robot else (0.04, 0.5)
                             if vehicle.grade != 'tactical' else (0.005, 0.3)))
    return Drawn({'odometer_jitter': 0.003}, {'odometer_delay': delay})


def speed_law(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Let tyres grow with the square of the speed."""
    return Drawn({'speed_law': lognormal(rng, 0.002, 0.6)})


def warming(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Let tyres grow as they warm up."""
    factor = 0.5 if vehicle.grade == 'tactical' else 1.0
    return Drawn({'warming': float(factor * rng.uniform(0.001, 0.004)),
                  'warming_time': lognormal(rng, 600.0, 0.4)})


def slip(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Let tyres slip under traction and braking."""
    return Drawn({'tyre_slip': 1 / lognormal(rng, 30.0, 0.4), 'driven': bool(rng.uniform() < 0.5)})


def sideslip(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Let the rear axle drift outwards by the lateral acceleration."""
    drift = rng.uniform(0, 0.1) if vehicle.robot else lognormal(rng, 0.22, 0.35)
    return Drawn({'sideslip': float(drift * DEG)})


def squat(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Let the body pitch and roll on its springs."""
    pitch, roll = (0.2, 0.5) if vehicle.robot else (lognormal(rng, 1.3, 0.4),
                                                    lognormal(rng, 4.5, 0.3))
    return Drawn({'squat': float(pitch * DEG / G), 'body_roll': float(roll * DEG / G)})


def lever_arms(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw errors of lever arms: measured with a tape, by eye, or left at zero."""
    zero, real = rng.uniform() < vehicle.size('arm at zero'), {}
    for name in ('imu', 'antenna', 'odometer'):
        error = vehicle.size('arm error') * rng.standard_normal(3)
        arm = np.array(vehicle.options[f'{name}_lever_arm'])
        real[f'{name}_arm_error'] = flat(-arm if zero else error)
    return Drawn(real)


def receiver_lag(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Filter positions as receivers do."""
    return Drawn({'receiver_lag': float(rng.uniform(0.01, 0.15))})


def fix_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Stamp fixes at their arrival, as half of the drivers do."""
    if vehicle.grade == 'tactical' or not (vehicle.alone or rng.uniform() < 0.5):
        return Drawn()
    return Drawn({'fix_jitter': 0.01}, {'fix_delay': lognormal(rng, 0.12, 0.4)})


def slow_errors(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw correlated errors: most with a time of one minute, the rest of 15 minutes."""
    if vehicle.rtk:
        return Drawn({'slow_errors': ((0.01, 100.0),)}, {'fix_sigma': 0.008})
    sbas_factor = 0.6 if rng.uniform() < 0.4 else 1.0
    sigma = sbas_factor * lognormal(rng, 1.5, 0.4)
    return Drawn({'slow_errors': ((sigma * 0.6**0.5, 60.0), (sigma * 0.4**0.5, 900.0))},
                 {'fix_sigma': float(rng.uniform(0.02, 0.3))})


def multipath(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw bursts of wrong positions in a city; with RTK, occasional wrong fixes."""
    if vehicle.rtk:
        return Drawn({'bursts': 12.0 if vehicle.city else 1.0, 'burst_size': 0.6,
                      'burst_time': 60.0})
    if not (vehicle.city or vehicle.alone):
        return Drawn()
    return Drawn({'bursts': 40.0, 'burst_size': 12.0, 'burst_time': 8.0})


def covariance(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """State sigmas that are not the true ones; in a city most are too small."""
    optimism = lognormal(rng, *((3.0, 0.7) if vehicle.city and not vehicle.rtk else (1.3, 0.5)))
    return Drawn({'stated_factor': 1 / optimism})


def outages(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw outages, and a loss of one fix in a hundred."""
    spans, span = [], 500.0
    for _ in range(int(rng.poisson(3.0 if vehicle.city else 1.0)) + vehicle.alone):
        begin = float(rng.uniform(30.0, span))
        spans.append((begin, begin + min(lognormal(rng, 10.0, 1.0), 90.0)))
    return Drawn({'drops': 0.01}, {'outages': tuple(sorted(spans))})


def fused_fixes(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Fuse an uncalibrated odometer into the fixes, as car head units do."""
    return Drawn({'receiver_odometer': float(rng.uniform(0.003, 0.02) * rng.choice((-1, 1))),
                  'receiver_odometer_time': lognormal(rng, 20.0, 0.5)})


def tracked_fixes(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Filter position and velocity, as receivers in vehicle mode do."""
    return Drawn({'receiver_tracking': float(rng.uniform(0.3, 1.0))})


def held_speed(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Hold a published speed until it has changed by a step, as many buses do."""
    return Drawn({'speed_hold': KMH * float(rng.choice((0.2, 0.5)))}, vehicle.speed_options)


def filtered_speed(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Send speeds after a low-pass filter, like most speed signals of cars."""
    return Drawn({'speed_filter': float(rng.uniform(0.2, 0.6))},
                 vehicle.speed_options | {'odometer_rate': 20.0})


def clocks(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Stamp odometer and fixes by clocks of their own."""
    odometer, fix = rng.uniform(2e-5, 1e-4, 2) * rng.choice((-1, 1), 2)
    return Drawn({'odometer_clock_rate': float(odometer), 'fix_clock_rate': float(fix)})


def late_fixes(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Stamp fixes at reception, after a latency that varies."""
    return Drawn({'fix_jitter': float(rng.uniform(0.05, 0.1))}, {'fix_delay': 0.25})


def tunnels(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Dead-reckon in the receiver through tunnels, with an odometer and a gyro of its own."""
    begins = rng.uniform((60.0, 300.0), (200.0, 420.0))
    return Drawn({'tunnels': tuple((float(b), float(rng.uniform(20.0, 120.0))) for b in begins),
                  'tunnel_odometer': float(rng.uniform(0.005, 0.02) * rng.choice((-1, 1))),
                  'tunnel_heading': float(DEG * rng.normal())})


def reflections(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Receive only reflections near a wall for half a minute, with slow onset and end."""
    return Drawn({'bursts': 20.0, 'burst_size': 12.0, 'burst_time': 30.0, 'burst_onset': 10.0})


def kerbs(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Drive on ground with cross slopes; in a yard over kerbs too."""
    lean = {'cross_slope': float(DEG * rng.uniform(1.0, 2.0))}
    if vehicle.kind != 'yard':
        return Drawn(lean | {'cross_slope_length': 200.0, 'wheelbase': 2.7})
    return Drawn(lean | {'kerbs': float(rng.uniform(0.04, 0.08)), 'wheelbase': 0.5})


def bias_steps(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Change the biases at a time in mid-drive: a knock, a strained board, another supply."""
    accel, gyro = rng.normal(size=(2, 3))
    return Drawn({'accel_step': flat(accel * MG * rng.uniform(1.0, 20.0) / np.linalg.norm(accel)),
                  'gyro_step': flat(gyro * DEG * rng.uniform(0.01, 0.2) / np.linalg.norm(gyro)),
                  'bias_step_at': float(rng.uniform(100.0, 300.0))})


EFFECTS = {f.__name__: f for f in (
    triads, g_sensitivity, bias, temperature, vibration, imu_stamps, grade,
    coarse_speed, coarse_pulses, odometer_stamps, speed_law, warming, slip, sideslip, squat,
    lever_arms, receiver_lag, fix_stamps, slow_errors, multipath, covariance, outages)}
# only with --effect NAME: receivers and buses of some vehicles
RARE = {f.__name__: f for f in (fused_fixes, tracked_fixes, held_speed, filtered_speed,
                                late_fixes, tunnels, reflections, kerbs, clocks, bias_steps)}
