# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrated values of a vehicle for dead reckoning; assumed ones are stated."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

import numpy as np

from odocal_ros.apply.attitude import cross, cross_matrix, rotate_vector, Vector
from odocal_ros.calib.result import Estimate
from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadConfig
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.rotations import matrix_from_rpy, quat_from_matrix
from odocal_ros.settings.node_configs import ApplyConfig

# rad, 1 sigma of angles without a calibration; judgement: 5 and 3 deg of mounting by eye
UNKNOWN_YAW, UNKNOWN_PITCH = 0.087, 0.05
SIDES = ('scale_factor_left', 'scale_factor_right')


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A calibrated vehicle; frame v: forward, left, up; frame b: that of the IMU."""

    scale: float            # m per unit of the odometer; two wheels: of their mean
    scale_sigma: float      # relative
    wheel_scales: tuple[float, float] | None      # left and right; None: mean only
    yaw: float              # rad, mounting angles
    pitch: float
    yaw_sigma: float
    pitch_sigma: float
    lever_arm: Floats       # (3,) m, position of the odometer in base_link
    gyro_bias: Floats | None      # (3,) rad/s in b as last calibrated, None: unknown
    assumptions: tuple[str, ...] = ()      # texts on values that are not in the calibration

    @cached_property
    def forward_b(self) -> Floats:
        """Return the vehicle's forward axis in b."""
        return forward_b(self.yaw, self.pitch)

    @cached_property
    def C_vb(self) -> Floats:
        """Return the rotation from b to the vehicle's axes."""
        return matrix_from_rpy([0.0, self.pitch, self.yaw])

    @cached_property
    def arm_b(self) -> Floats:
        """Return the vector from the odometer's point to base_link, in b: (3,) m."""
        return -self.C_vb.T @ self.lever_arm

    @cached_property
    def twist_b(self) -> Floats:
        """Return the matrix from a turn rate in b to the twist of base_link: (6, 3)."""
        return np.concatenate([cross_matrix(self.lever_arm.tolist()), np.eye(3)]) @ self.C_vb

    def twist_by_turn(self, rate_b: Vector) -> tuple[float, ...]:
        """Return ``twist_b`` times a turn rate in b, rad/s, as numbers."""
        C_vb, lever_arm = self._as_lists
        rate_v = rotate_vector(C_vb, rate_b)
        return *cross(lever_arm, rate_v), *rate_v

    @cached_property
    def _as_lists(self) -> Sequence[Any]:
        return self.C_vb.tolist(), self.lever_arm.tolist()

    @cached_property
    def q_bv(self) -> Floats:
        """Return the attitude of the vehicle in b, x y z w."""
        return quat_from_matrix(self.C_vb.T)


def vehicle_of(estimates: dict[str, Estimate], config: ApplyConfig) -> Vehicle:
    """Return the vehicle; BadConfig without a scale factor, or with more than two wheels."""
    def estimate_of(name: str, default: float, sigma: float = 0.0) -> tuple[float, float]:
        estimate = estimates.get(name)
        if estimate is None or estimate.value is None:
            return default, sigma
        return estimate.value, sigma if estimate.sigma is None else estimate.sigma

    if len(config.odometer.wheels) > len(SIDES):
        raise BadConfig(f'odometer.wheels has {len(config.odometer.wheels)} wheels; the limit of '
                        'this node is 2: name the wheels of an axle that does not steer')
    # the odometry uses speeds without corrections, for which another factor is calibrated
    scale, sigma = estimate_of('scale_factor_as_sent', *estimate_of('scale_factor', math.nan))
    left, right = (estimate_of(name, math.nan)[0] for name in SIDES)
    if math.isnan(scale):
        raise BadConfig('the calibration holds no result.scale_factor: start with --params-file '
                        'FILE, where FILE is a calibration.yaml of odocal replay or the '
                        'calibrator')
    nominal = config.imu.nominal_yaw
    yaw = estimate_of('yaw_mounting_angle', 0.0 if math.isnan(nominal) else nominal, UNKNOWN_YAW)
    pitch = estimate_of('pitch_mounting_angle', 0.0, UNKNOWN_PITCH)
    assumptions = tuple(f'{name} is not in the calibration: assumed {value:.4g} ± {sigma:.2g} rad'
                        for name, (value, sigma) in (('yaw_mounting_angle', yaw),
                                                     ('pitch_mounting_angle', pitch))
                        if name not in estimates or estimates[name].value is None)
    bias = np.array([estimate_of(f'gyro_bias_{axis}', math.nan)[0] for axis in 'xyz'])
    return Vehicle(
        scale, sigma / scale, None if math.isnan(left + right) else (left, right),
        yaw[0], pitch[0], yaw[1], pitch[1],
        np.array([estimate_of(f'odometer_lever_arm_{axis}', value)[0] for axis, value in zip(
            'xyz', config.odometer.lever_arm, strict=True)]),
        None if np.isnan(bias).any() else bias, assumptions)
