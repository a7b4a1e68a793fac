# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses and twists of the odometry, with their covariances."""

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np

from odocal_ros.apply.errors import BG, Errors
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import SWAY

# definition: in the numbers of a pose, diagonals of both covariances
VARIANCES = np.r_[7:43:7, 49:85:7]
AXES, POSITION = np.eye(3), np.arange(3)


@dataclass(frozen=True, eq=False)
class Pose:
    """
    Pose of the vehicle, and mean motion since the previous pose.

    stamp_ns : of the IMU.   position : (3,) m of base_link in odom.   q : (4,) x y z w of
    base_link in odom.   velocity, rate : (3,) m/s, rad/s in base_link, of base_link.
    pose_cov, twist_cov : (6, 6); of the pose position and rotation about the axes of odom.
    """

    stamp_ns: int
    position: Floats
    q: Floats
    velocity: Floats
    rate: Floats
    pose_cov: Floats
    twist_cov: Floats

    @cached_property
    def numbers(self) -> Floats:
        """Return all floats of a nav_msgs/Odometry in its order; its twist's are the last 42."""
        return np.concatenate([
            self.position, self.q, self.pose_cov.ravel(), self.velocity, self.rate,
            self.twist_cov.ravel()])

    def sound(self) -> bool:
        """Return True if all values are finite and no variance is negative."""
        return math.isfinite(self.numbers.sum()) and bool(self.numbers[VARIANCES].min() >= 0)


def pose_covariance(vehicle: Vehicle, errors: Errors, C_nb: Floats, arm_n: Floats, late: Floats,
                    along: float) -> Floats:
    """
    Return the covariance of position and rotation: (6, 6).

    C_nb, arm_n : as ``Errors.pose`` takes them.   late : (6,) m, rad, sigma of a common cause.
    along : m^2, of a count along the path, at this time.
    """
    off = np.zeros((3, 6))
    off[0], off[1, :3], off[2, :3] = late, C_nb @ vehicle.forward_b * math.sqrt(along), errors.bent
    return errors.pose(C_nb, arm_n) + off.T @ off


def twist_covariance(vehicle: Vehicle, errors: Errors, speed: float, rate: Floats, T: float,
                     variance: float) -> Floats:
    """
    Return the covariance of a mean twist over T s, of base_link: (6, 6).

    speed : m/s, of the odometer's point.   rate : (3,) rad/s.   variance : m^2, of travel in T
    beside that of scale and road.
    """
    B, grade = vehicle.twist_b, errors.grade
    turn_b = errors.cov[BG, BG] + AXES * (grade.gyro_noise**2 / T)
    off_b = rate @ vehicle.C_vb * grade.gyro_scale_error
    turn_b += off_b[:, None] * off_b
    cov: Floats = B @ turn_b @ B.T
    # a body that turns too much about an arm moves too much
    along = (speed * vehicle.scale_sigma)**2 + variance / T**2 + 1e-6
    cov[POSITION, POSITION] += [along, SWAY**2, SWAY**2] + errors.road(speed * T) / T**2
    return cov
