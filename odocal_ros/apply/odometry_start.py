# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Start of the odometry: attitude, gyro bias and their uncertainties.

In: the first rows of IMU and wheels, or configured values. At rest, gravity gives the tilt and the
gyro its bias; while driving, the tilt is less certain and the bias is that of the calibration.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.apply.errors import Errors, GRAVITY, MAX_ACCELERATION
from odocal_ros.apply.stream import IMU_GAP_INTERVALS, ImuStream
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheels import Wheels
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import level_frame, level_to_n_rotation
from odocal_ros.nav.geodesy import earth_rate_n
from odocal_ros.nav.rotations import quat_from_matrix
from odocal_ros.nav.standstill import MAX_BIAS, REST_TURN
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.settings.nominal import Grade

MAX_TILT_RATE = 0.5       # rad/s; physical: largest mean rate of roll and pitch over START_SPAN
START_SPAN = 2.0           # s; judgement: duration of the samples of a start
CONFIGURED_TILT_SIGMA = 0.01    # rad; judgement: tilt of a configured attitude
ROAD_TILT_SIGMA = 0.1      # rad; physical: a road slope of 10 %
START_GAP = 0.5            # s; judgement: largest IMU gap in the samples of a start
BRAKING_SIGMA = 2.0        # m/s^2; physical: mean acceleration over START_SPAN


class Start(NamedTuple):
    """State from which dead reckoning starts."""

    row: int                # of the IMU stream
    q_nb: Floats            # (4,) x, y, z, w; n is the frame odom
    gyro_bias: Floats       # (3,) rad/s in b
    earth_rate_n: Floats    # (3,) rad/s; zeros if the gyro bias contains it
    errors: Errors


def find_start(imu: ImuStream, wheels: Wheels, vehicle: Vehicle, config: ApplyConfig,
               grade: Grade) -> Start | None:
    """Return the start, None while there are too few samples."""
    if not wheels.are_complete() or not imu.rows:
        return None
    row = imu.from_time(wheels.begin_time())
    if config.start.attitude:
        return _start_from_settings(row, vehicle, config, grade) if len(imu.rows) > row else None
    end = imu.from_time(imu.rows[row].t + START_SPAN) if row < len(imu.rows) else row
    if end >= len(imu.rows) or wheels.end_time() < imu.rows[end].t:
        return None
    rows = imu.rows[row:end + 1]
    t, w, f = map(np.array, zip(*((imu_row.t, imu_row.w_b, imu_row.f_b) for imu_row in rows),
                                strict=True))
    gaps = np.flatnonzero(np.diff(t) > max(START_GAP, IMU_GAP_INTERVALS * imu.median_interval))
    if len(gaps):
        imu.drop(row + int(gaps[-1]) + 1)      # start from the rows after the gap
        return None
    is_resting = wheels.are_still(t[0], t[-1]) and bool(
        (w.std(axis=0) < REST_TURN).all() and (np.abs(w.mean(axis=0)) < MAX_BIAS).all())
    w_mean, up = w.mean(axis=0), f.mean(axis=0) / np.linalg.norm(f.mean(axis=0))
    tilt_rate_b = w_mean - up * (w_mean @ up)      # NaN without force: not tested
    if not is_resting and np.linalg.norm(tilt_rate_b) > MAX_TILT_RATE:
        imu.drop(end)       # implausible gyro data: start later
        return None
    return _start_by_gravity(end, float(t[-1] - t[0]), w, f, is_resting, vehicle, grade)


def _start_from_settings(row: int, vehicle: Vehicle, config: ApplyConfig, grade: Grade) -> Start:
    """Return the start with the configured attitude, gyro bias and latitude."""
    start = config.start
    q = np.asarray(start.attitude)
    earth_in_bias = bool(np.isnan(start.latitude))
    errors = Errors(grade, vehicle, CONFIGURED_TILT_SIGMA, grade.gyro_bias,
                    earth_in_bias=earth_in_bias)
    earth_rate = np.zeros(3) if earth_in_bias else earth_rate_n(np.deg2rad(start.latitude))
    return Start(row, q / np.linalg.norm(q), np.array(start.gyro_bias), earth_rate, errors)


def _start_by_gravity(row: int, length: float, w: Floats, f: Floats, is_resting: bool,
                      vehicle: Vehicle, grade: Grade) -> Start:
    """
    Return the start by gravity, x forward; gyro bias as measured at rest, or calibrated.

    length : s, duration of the samples.   w, f : (n, 3) rad/s, m/s^2 in b.
    """
    mean = f.mean(axis=0)
    has_gravity = bool(abs(np.linalg.norm(mean) - GRAVITY) < MAX_ACCELERATION)    # False for NaN
    C_Lb = level_frame(mean) if has_gravity else vehicle.C_vb
    forward = C_Lb @ vehicle.forward_b
    C_nb = level_to_n_rotation(-np.arctan2(forward[1], forward[0])) @ C_Lb
    if is_resting:
        bias = w.mean(axis=0)
        noise = np.maximum(grade.gyro_noise / np.sqrt(length), w.std(axis=0) / np.sqrt(len(w)))
        sigma = np.hypot(noise, grade.gyro_bias_walk * np.sqrt(length))
    else:
        bias = np.zeros(3) if vehicle.gyro_bias is None else vehicle.gyro_bias
        sigma = grade.gyro_bias
    errors = Errors(grade, vehicle, ROAD_TILT_SIGMA, sigma, earth_in_bias=True)
    if has_gravity:        # correlates the tilt with the accelerometer bias
        errors.correct_by_gravity(C_nb, residual_n=np.zeros(3), T=length,
                                  sigma=0.0 if is_resting else BRAKING_SIGMA)
    return Start(row, quat_from_matrix(C_nb), bias, np.zeros(3), errors)
