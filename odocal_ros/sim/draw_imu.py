# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Effects of a drawn vehicle's Imu, after the tables of docs/zoo.md; C, I, T are its classes."""

import math

import numpy as np

from odocal_ros.settings.grades import GRADES

DEG, MG, K_HOUR = math.radians(1.0), 9.81e-3, math.radians(1.0) / 3600
G = 9.81
CLASSES = ('consumer', 'industrial', 'tactical')
# each for C, I, T; 1 sigma, or (median, sigma of the logarithm)
GYRO_SCALE, ACCEL_SCALE = (0.01, 1.5e-3, 3e-4), (0.01, 2e-3, 3e-4)
CROSS, BETWEEN = (0.4 * DEG, 0.05 * DEG, 3e-4), (0.5 * DEG, 0.1 * DEG, 1e-3)
SENSITIVITY = (0.05 * DEG / G, 0.008 * DEG / G, K_HOUR / G)
GYRO_BIAS, ACCEL_BIAS = (DEG, 0.1 * DEG, 5 * K_HOUR), (25 * MG, 3 * MG, MG)
GYRO_WANDER = (200 * K_HOUR, 25 * K_HOUR, 0.5 * K_HOUR)
ACCEL_WANDER = (MG, 0.2 * MG, 0.05 * MG)
GYRO_SLOPE = ((0.02 * DEG, 0.7), (0.002 * DEG, 0.5), (0.5 * K_HOUR, 0.5))
ACCEL_SLOPE = ((0.5 * MG, 0.5), (0.05 * MG, 0.5), (0.02 * MG, 0.5))
WARMTH = ((5.0, 25.0), (3.0, 10.0), (3.0, 5.0))     # K
RECTIFIED = (0.3e-3 / G, 0.06e-3 / G, 0.01e-3 / G)  # m/s^2 per (m/s^2)^2: mg per g^2
LATENCY = ((0.010, 0.6), (0.005, 0.5), (0.002, 0.5))
FILTER = ((0.002, 0.019), (0.002, 0.010), (0.001, 0.016))
JITTER = (3e-3, 1e-3, 1e-5)
MOST = 3.0           # sigmas at which a data sheet's limit cuts


def _of(table, vehicle):
    return table[CLASSES.index(vehicle.grade)]


def _plain(values):
    return tuple(float(x) for x in np.ravel(values))


def _lognormal(rng, pair, size=None):
    median, spread = pair
    return median * np.exp(spread * rng.standard_normal(size))


def _limited(rng, sigma, size):
    return sigma * np.clip(rng.standard_normal(size), -MOST, MOST)


def triads(rng, vehicle):
    """Scale of each axis, axes that are not square, a gyro turned against its accelerometer."""
    x, y, z = rng.normal(0.0, _of(BETWEEN, vehicle) / math.sqrt(2), 3)
    turned = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])    # half of it each way
    figures = {}
    for name, scale, sign in (('gyro_matrix', GYRO_SCALE, 1), ('accel_matrix', ACCEL_SCALE, -1)):
        M = rng.normal(0.0, _of(CROSS, vehicle), (3, 3)) + sign * turned / math.sqrt(2)
        np.fill_diagonal(M, _limited(rng, _of(scale, vehicle), 3))
        figures[name] = _plain(M)
    return {}, figures


def g_sensitivity(rng, vehicle):
    """Let the gyro feel specific force."""
    return {}, {'g_sensitivity': _plain(rng.normal(0.0, _of(SENSITIVITY, vehicle), 9))}


def bias(rng, vehicle):
    """Turn-on biases of the vehicle's table, and their wander in the run."""
    return {}, {'gyro_bias': _plain(rng.normal(0.0, _of(GYRO_BIAS, vehicle), 3)),
                'accel_bias': _plain(rng.normal(0.0, _of(ACCEL_BIAS, vehicle), 3) * [1, 1, 1.3]),
                'gyro_wander': _of(GYRO_WANDER, vehicle),
                'accel_wander': _of(ACCEL_WANDER, vehicle)}


def temperature(rng, vehicle):
    """Biases that ramp while the Imu warms; it may have been on for some minutes."""
    tau = float(_lognormal(rng, (300.0, 0.5)))
    since = rng.uniform(0.0, 600.0)
    slopes = {f'{name}_slope': _plain(rng.choice([-1, 1], 3) * _lognormal(
        rng, _of(table, vehicle), 3)) for name, table in (('gyro', GYRO_SLOPE),
                                                          ('accel', ACCEL_SLOPE))}
    rise = rng.uniform(*_of(WARMTH, vehicle)) * math.exp(-since / tau)
    return {}, slopes | {'warm_rise': float(rise), 'warm_time': tau}


def vibration(rng, vehicle):
    """Shake the Imu by road and engine."""
    rms = G * rng.uniform(0.02, 0.1)
    return {}, {'vibration': float(rms), 'gyro_vibration': float(DEG * rng.uniform(0.1, 0.5)),
                'rectification': float(_of(RECTIFIED, vehicle) * rng.choice([-1, 1]))}


def imu_stamps(rng, vehicle):
    """Stamps late by the sensor's filter and the way to the computer, jittered, in batches."""
    latency = rng.uniform(*_of(FILTER, vehicle)) + _lognormal(rng, _of(LATENCY, vehicle))
    batches = vehicle.grade == 'industrial' and rng.uniform() < 0.3
    return {}, {'imu_latency': float(latency), 'imu_jitter': _of(JITTER, vehicle),
                'imu_batch': 2 if batches else 1}


def grade(rng, vehicle):
    """Let ``imu.grade`` be set right, one too good, or one too modest (navigation, consumer)."""
    names = list(GRADES)
    told = names.index(vehicle.grade) + int(rng.integers(-1, 2))
    told_grade = names[max(0, min(told, len(names) - 1))]
    return {}, {} if told_grade == vehicle.grade else {'told_grade': told_grade}


EFFECTS = {'triads': triads, 'g_sensitivity': g_sensitivity, 'bias': bias,
           'temperature': temperature, 'vibration': vibration, 'imu_stamps': imu_stamps,
           'grade': grade}
