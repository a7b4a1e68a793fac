# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
An IMU that sends turn rates only: a car's yaw rate on the bus, the gyro of a robot.

The ground is then taken as level and the IMU as upright: gravity stands where an accelerometer
would show it, so that all that follows needs no other case; what that may be wrong by goes into
the level (``pipeline/align.py``) and the scale (``pipeline/scale_error.py``).
"""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import Leg
from odocal_ros.data.pieces import chunks
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.grades import G

TILT_SIGMA = 0.05    # rad of road and mounting, 1 sigma of each axis; judgement


def felt(f_i: Floats) -> bool:
    """Return True if any of the (n, 3) forces is valid, or none has arrived yet."""
    if not len(f_i):
        return True
    with np.errstate(invalid='ignore'):      # a NaN that signals
        return any(not (np.isnan(f_i[rows]) | (f_i[rows] == 0)).all()
                   for rows in chunks(len(f_i)))


def with_force(leg: Leg, config: Config) -> tuple[Leg, tuple[Reason, ...]]:
    """
    Return a leg whose IMU, where it sends no force, stands upright on level ground; and why.

    None is sent where each value is zero or NaN (as REP-145's covariance[0] of -1 is read).
    """
    f_i = leg.imu.f_i
    if felt(f_i):
        return leg, ()
    up_i = matrix_from_rpy(config.imu.mounting_rpy).T[:, 2]
    gravity_i = np.tile(up_i * G / (config.imu.accel_scale or 1.0), (len(f_i), 1))
    return replace(leg, imu=replace(leg.imu, f_i=gravity_i)), (Reason(
        Code.NO_ACCELEROMETER, 'the IMU publishes turn rates but no acceleration. The scale is '
        'estimated from gyro, odometer and fixes on assumed level ground; yaw and pitch mounting '
        'need an accelerometer (yaw: or an external heading)'),)
