# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses and twists of the odometry, with their covariances."""

from collections.abc import Sequence
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
AXES = np.eye(3)


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


def twist_covariance(vehicle: Vehicle, errors: Errors, speed: float, swing: Sequence[float],
                     T: float, variance: float) -> Floats:
    """
    Return the covariance of a mean twist over T s, of base_link: (6, 6).

    speed : m/s, of the odometer's point.   swing : 6 m/s, rad/s, the twist but for the speed.
    variance : m^2, of travel in T beside that of scale and road.
    """
    B, grade = vehicle.twist_b, errors.grade
    turn_b = errors.cov[BG, BG] + AXES * (grade.gyro_noise**2 / T)
    along, left, up = (variance / T for variance in errors.road(speed))
    along += (speed * vehicle.scale_sigma)**2 + variance / T**2 + 1e-6
    # a body that turns too much about an arm moves too much
    off = np.array([[one * grade.gyro_scale_error for one in swing],
                    [math.sqrt(along), 0.0, 0.0, 0.0, 0.0, 0.0],
                    [0.0, math.sqrt(left + SWAY**2), 0.0, 0.0, 0.0, 0.0],
                    [0.0, 0.0, math.sqrt(up + SWAY**2), 0.0, 0.0, 0.0]])
    cov: Floats = B @ turn_b @ B.T + off.T @ off
    return cov
