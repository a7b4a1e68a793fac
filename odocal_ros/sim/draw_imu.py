# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Effects of a drawn vehicle's IMU, after the tables of docs/zoo.md; C, I, T are its classes."""

import math

import numpy as np

from odocal_ros.settings.grades import GRADES
from odocal_ros.sim.zoo import DEG, Drawn, G, lognormal, plain, Vehicle


def triads(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Scale of each axis, axes that are not square, a gyro turned against its accelerometer."""
    x, y, z = rng.normal(0.0, vehicle.size('between') / math.sqrt(2), 3)
    turned = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])    # half of it to each side
    figures = {}
    for name, sensor, sign in (('gyro_matrix', 'gyro', 1), ('accel_matrix', 'accelerometer', -1)):
        M = rng.normal(0.0, vehicle.size('cross'), (3, 3)) + sign * turned / math.sqrt(2)
        # the limit of a data sheet cuts at three sigmas
        np.fill_diagonal(M, vehicle.size(f'{sensor} scale')
                         * np.clip(rng.standard_normal(3), -3.0, 3.0))
        figures[name] = plain(M)
    return {}, figures


def g_sensitivity(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Draw the g-sensitivity of the gyro."""
    return {}, {'g_sensitivity': plain(rng.normal(0.0, vehicle.size('g sensitivity'), 9))}


def bias(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Turn-on biases of the vehicle's table, and their drift during the run."""
    return {}, {
        'gyro_bias': plain(rng.normal(0.0, vehicle.size('gyro bias'), 3)),
        'accel_bias': plain(rng.normal(0.0, vehicle.size('accelerometer bias'), 3) * [1, 1, 1.3]),
        'gyro_wander': vehicle.size('gyro wander'),
        'accel_wander': vehicle.size('accelerometer wander')}


def temperature(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Biases that ramp while the IMU warms; it may have been on for some minutes."""
    tau = lognormal(rng, 300.0, 0.5)
    since = rng.uniform(0.0, 600.0)
    figures = {}
    for name, sensor in (('gyro_slope', 'gyro'), ('accel_slope', 'accelerometer')):
        median, spread = vehicle.row(f'{sensor} slope')
        sign = rng.choice([-1, 1], 3)
        figures[name] = plain(sign * (median * np.exp(spread * rng.standard_normal(3))))
    least, most = vehicle.row('warmth')
    rise = rng.uniform(least, most) * math.exp(-since / tau)
    return {}, figures | {'warm_rise': float(rise), 'warm_time': tau}


def vibration(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Shake the IMU by road and engine."""
    rms = G * rng.uniform(0.02, 0.1)
    return {}, {'vibration': float(rms), 'gyro_vibration': float(DEG * rng.uniform(0.1, 0.5)),
                'rectification': float(vehicle.size('rectified') * rng.choice([-1, 1]))}


def imu_stamps(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Stamps late by filter and transport delay, with jitter, in batches."""
    shortest, longest = vehicle.row('filter')
    latency = rng.uniform(shortest, longest) + lognormal(rng, *vehicle.row('latency'))
    batches = vehicle.grade == 'industrial' and rng.uniform() < 0.3
    return {}, {'imu_latency': float(latency), 'imu_jitter': vehicle.size('imu jitter'),
                'imu_batch': 2 if batches else 1}


def grade(rng: np.random.Generator, vehicle: Vehicle) -> Drawn:
    """Let ``imu.grade`` be set right, one too good, or one too modest (navigation, consumer)."""
    names = list(GRADES)
    stated = names.index(vehicle.grade) + int(rng.integers(-1, 2))
    told_grade = names[max(0, min(stated, len(names) - 1))]
    return {}, {} if told_grade == vehicle.grade else {'told_grade': told_grade}


EFFECTS = {'triads': triads, 'g_sensitivity': g_sensitivity, 'bias': bias,
           'temperature': temperature, 'vibration': vibration, 'imu_stamps': imu_stamps,
           'grade': grade}
