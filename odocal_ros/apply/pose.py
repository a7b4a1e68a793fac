# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses and twists of the odometry, with their covariances."""

from dataclasses import dataclass
import math

import numpy as np

from odocal_ros.apply.attitude import skewed
from odocal_ros.apply.errors import BG, Errors
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import SWAY


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

    def sound(self) -> bool:
        """Return True if all values are finite and no variance is negative."""
        total = sum(float(x.sum()) for x in (self.position, self.q, self.velocity, self.rate,
                                             self.pose_cov, self.twist_cov))
        return math.isfinite(total) and bool(
            min(self.pose_cov.diagonal().min(), self.twist_cov.diagonal().min()) >= 0)


def pose_covariance(vehicle: Vehicle, errors: Errors, C_nb: Floats, arm_n: Floats,
                    along: float) -> Floats:
    """
    Return the covariance of position and rotation: (6, 6).

    C_nb, arm_n : as ``Errors.pose`` takes them.   along : m^2, of a count along the path, at this
    time.
    """
    cov = errors.pose(C_nb, arm_n)
    forward_n = C_nb @ vehicle.forward_b
    cov[:3, :3] += np.outer(forward_n, forward_n) * along
    return cov


def twist_covariance(vehicle: Vehicle, errors: Errors, speed: float, rate: Floats, T: float,
                     variance: float) -> Floats:
    """
    Return the covariance of a mean twist over T s, of base_link: (6, 6).

    speed : m/s, of the odometer's point.   rate : (3,) rad/s.   variance : m^2, of travel in T
    beside that of scale and road.
    """
    C_vb, grade = vehicle.C_vb, errors.grade
    turn = C_vb @ errors.cov[BG, BG] @ C_vb.T + np.eye(3) * grade.gyro_noise**2 / T
    turn += np.outer(rate, rate) * grade.gyro_scale_error**2
    # a body that turns too much about an arm moves too much
    arm = skewed(vehicle.lever_arm)
    along = np.array([(speed * vehicle.scale_sigma)**2 + variance / T**2, SWAY**2, SWAY**2])
    cov = np.zeros((6, 6))
    cov[:3, :3] = np.diag(along + errors.road(speed * T) / T**2 + [1e-6, 0.0, 0.0])
    cov[:3, :3] += arm @ turn @ arm.T
    cov[:3, 3:] = arm @ turn
    cov[3:, :3], cov[3:, 3:] = cov[:3, 3:].T, turn
    return cov
