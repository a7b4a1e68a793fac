# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values of a vehicle for dead reckoning: from its calibration, or assumed with a text on it."""

from dataclasses import dataclass, field
import math

import numpy as np

from odocal_ros.apply.attitude import cross, rotate_vector, Vector
from odocal_ros.calib.result import Estimate
from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadConfig
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.rotations import matrix_from_rpy, quat_from_matrix, skew
from odocal_ros.settings.node_configs import ApplyConfig

# rad, 1 sigma of angles without a calibration; judgement: 5 and 3 deg of mounting by eye
UNKNOWN_YAW, UNKNOWN_PITCH = 0.087, 0.05
WHEEL_SCALES = ('scale_factor_left', 'scale_factor_right')


@dataclass(eq=False)
class Vehicle:
    """A calibrated vehicle; frame v: forward, left, up; frame b: that of the IMU."""

    scale: float            # m per unit of the odometer; two wheels: of their mean
    scale_sigma: float      # relative
    wheel_scales: tuple[float, float] | None      # left and right; None: mean only
    yaw: float              # rad, mounting angles of the IMU, and their sigmas
    pitch: float
    yaw_sigma: float
    pitch_sigma: float
    lever_arm: Floats       # (3,) m, position of the odometer in base_link
    gyro_bias: Floats | None      # (3,) rad/s in b as last calibrated, None: unknown
    assumptions: tuple[str, ...] = ()      # texts on values that are not in the calibration
    forward_b: Floats = field(init=False)      # (3,) forward axis of the vehicle
    C_vb: Floats = field(init=False)           # (3, 3) rotation from b to v
    q_bv: Floats = field(init=False)           # (4,) attitude of v in b, x y z w
    arm_b: Floats = field(init=False)          # (3,) m, from the odometer's point to base_link
    twist_b: Floats = field(init=False)        # (6, 3) from a turn rate in b to base_link's twist

    def __post_init__(self) -> None:
        self.forward_b = forward_b(self.yaw, self.pitch)
        self.C_vb = matrix_from_rpy([0.0, self.pitch, self.yaw])
        self.q_bv = quat_from_matrix(self.C_vb.T)
        self.arm_b = -self.C_vb.T @ self.lever_arm
        self.twist_b = np.concatenate([skew(self.lever_arm), np.eye(3)]) @ self.C_vb

    def twist_by_turn(self, rate_b: Vector) -> tuple[float, ...]:
        """Return ``twist_b`` times a turn rate in b, rad/s: (6,) m/s, rad/s, as numbers."""
        rate_v = rotate_vector(self.C_vb.tolist(), rate_b)
        return *cross(self.lever_arm.tolist(), rate_v), *rate_v


def vehicle_of(estimates: dict[str, Estimate], config: ApplyConfig) -> Vehicle:
    """Return the vehicle; BadConfig without a scale factor, or with more than two wheels."""
    def estimate_of(name: str, default: float, sigma: float = 0.0) -> tuple[float, float]:
        estimate = estimates.get(name)
        if estimate is None or estimate.value is None:
            return default, sigma
        return estimate.value, sigma if estimate.sigma is None else estimate.sigma

    if len(config.odometer.wheels) > len(WHEEL_SCALES):
        raise BadConfig(f'odometer.wheels has {len(config.odometer.wheels)} wheels; the limit of '
                        'this node is 2: name the wheels of an axle that does not steer')
    # the odometry uses speeds without corrections, for which another factor is calibrated
    scale, sigma = estimate_of('scale_factor_as_sent', *estimate_of('scale_factor', math.nan))
    left, right = (estimate_of(name, math.nan)[0] for name in WHEEL_SCALES)
    if math.isnan(scale):
        raise BadConfig('the calibration holds no result.scale_factor: start with --params-file '
                        'FILE, where FILE is a calibration.yaml of odocal replay or the '
                        'calibrator')
    nominal = config.imu.nominal_yaw
    defaults = {'yaw_mounting_angle': (0.0 if math.isnan(nominal) else nominal, UNKNOWN_YAW),
                'pitch_mounting_angle': (0.0, UNKNOWN_PITCH)}
    (yaw, yaw_sigma), (pitch, pitch_sigma) = (
        estimate_of(name, *default) for name, default in defaults.items())
    assumptions = tuple(f'{name} is not in the calibration: assumed {value:.4g} ± {angle:.2g} rad'
                        for name, (value, angle) in defaults.items()
                        if name not in estimates or estimates[name].value is None)
    bias = np.array([estimate_of(f'gyro_bias_{axis}', math.nan)[0] for axis in 'xyz'])
    return Vehicle(
        scale, sigma / scale, None if math.isnan(left + right) else (left, right),
        yaw, pitch, yaw_sigma, pitch_sigma,
        np.array([estimate_of(f'odometer_lever_arm_{axis}', value)[0] for axis, value in zip(
            'xyz', config.odometer.lever_arm, strict=True)]),
        None if np.isnan(bias).any() else bias, assumptions)
