# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Poses and twists of the odometry, with their covariances, as the floats of nav_msgs/Odometry.

In: numbers and covariances of dead reckoning. Out: their bytes as in a message, since setting the
fields of a message object takes longer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
import struct
from typing import Any

import numpy as np

from odocal_ros.apply.attitude import Quaternion, Vector
from odocal_ros.apply.errors import Errors
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import SWAY

# format: floats of nav_msgs/Odometry; those of pose and twist before their covariances
NUMBERS, POSE_MEAN, TWIST_MEAN = struct.Struct('<85d'), struct.Struct('<7d'), struct.Struct('<6d')
TWIST_OFFSET = 43 * 8     # format: bytes before the twist
ZEROS = (0.0,) * 6      # definition


def _floats(start: int, stop: int, *shape: int) -> Any:
    """Return a property for some of the floats of a pose, with a shape."""
    return property(lambda pose: pose.numbers[start:stop].reshape(*shape))


@dataclass(frozen=True, eq=False)
class Pose:
    """
    Pose at the stamp of an IMU sample, and mean velocity and turn rate since the previous one.

    raw : the 85 floats of pose and twist with covariances, as in nav_msgs/Odometry.
    """

    stamp_ns: int
    raw: bytes
    position = _floats(0, 3, 3)            # m, of base_link in odom
    q = _floats(3, 7, 4)                   # attitude of base_link in odom, x y z w
    pose_cov = _floats(7, 43, 6, 6)        # of position and rotation about the axes of odom
    velocity = _floats(43, 46, 3)          # m/s, of base_link in base_link
    rate = _floats(46, 49, 3)              # rad/s, turn rate of base_link in base_link
    twist_cov = _floats(49, 85, 6, 6)      # of velocity and rate

    @property
    def numbers(self) -> Floats:
        """Return all floats, (85,)."""
        return np.frombuffer(self.raw)

    def is_valid(self) -> bool:
        """Return True if all values are finite and no variance is negative."""
        values = NUMBERS.unpack(self.raw)
        return math.isfinite(sum(values)) and min(values[7:43:7] + values[49::7]) >= 0


def pack_pose(position: Vector, q: Quaternion, twist: Sequence[float],
              covariances: Sequence[bytes]) -> bytes:
    """Return the floats of a pose as in a message: m, x y z w, 6 m/s, rad/s, two covariances."""
    pose_cov, twist_cov = covariances
    return POSE_MEAN.pack(*position, *q) + pose_cov + TWIST_MEAN.pack(*twist) + twist_cov


def covariances(error_covariances: Floats, delay_effect: Sequence[float],
                travel_effect_n: Sequence[float], gyro_scale_effect: Sequence[float],
                velocity_variances: Sequence[float]) -> list[bytes]:
    """
    Return the covariances of pose and twist, (6, 6) each, as in a message.

    error_covariances : (2, 6, 6), by the error state.   delay_effect : (6,) of one sigma of the
    delay on the pose.   travel_effect_n : (3,) m, of one sigma of the travel on the position.
    gyro_scale_effect : (6,) of one sigma of the gyro scale on the twist.   velocity_variances :
    (3,) (m/s)^2.
    """
    x, y, z = map(math.sqrt, velocity_variances)
    # the effects of independent errors on pose and twist, four rows each: (2, 4, 6)
    effects = np.array([[delay_effect, (*travel_effect_n, *ZEROS[3:]), ZEROS, ZEROS],
                        [gyro_scale_effect, (x, *ZEROS[1:]), (0.0, y, *ZEROS[2:]),
                         (0.0, 0.0, z, *ZEROS[3:])]])
    return [cov.tobytes() for cov in error_covariances + effects.swapaxes(1, 2) @ effects]


def mean_velocity_variances(vehicle: Vehicle, speed: float, T: float,
                            travel_variance: float) -> Vector:
    """
    Return the variances of the mean velocity of base_link over T s, (m/s)^2.

    speed : m/s, of the odometer's point.   travel_variance : m^2, in T s, without those of scale
    and slip.
    """
    along, left, up = (variance / T for variance in Errors.slip_variances(speed))
    # at least 1 mm/s
    along += (speed * vehicle.scale_sigma)**2 + travel_variance / T**2 + 1e-6
    return along, left + SWAY**2, up + SWAY**2
