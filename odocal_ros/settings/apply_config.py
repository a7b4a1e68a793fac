# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of the node ``odometry``: those of the calibrator's inputs, and a few of its own."""

from dataclasses import dataclass

from odocal_ros.settings.config import ImuConfig, NAN, OdometerConfig
from odocal_ros.settings.setting import setting


@dataclass(frozen=True, kw_only=True)
class StartConfig:
    attitude: tuple[float, ...] = setting((), 'x, y, z, w', -1.0, 1.0, ro=True, about=(
        'Attitude of the IMU (body frame b) in the odom frame at the first message, from another '
        'system; empty: levelled by the accelerometer, heading along x.'))
    gyro_bias: tuple[float, ...] = setting((0.0, 0.0, 0.0), 'rad/s', -1.0, 1.0, ro=True, about=(
        'Gyro bias in b that belongs to this attitude.'))
    latitude: float = setting(NAN, 'deg', -90.0, 90.0, ro=True, about='Latitude, if the attitude '
                              'is given in east-north-up: the Earth rate is removed from the '
                              'turn rates. NaN: it remains in the gyro bias measured at rest.')


@dataclass(frozen=True, kw_only=True)
class RateConfig:
    rate: float = setting(20.0, 'Hz', 1.0, 200.0, ro=True, about='Highest publishing rate; '
                          'twists are means since the previous message.')


@dataclass(frozen=True, kw_only=True)
class OdomFrames:
    base: str = setting('base_link', ro=True, frame=True, about='Vehicle frame: frame of the '
                        'twist and child frame of the odometry.')
    odom: str = setting('odom', ro=True, frame=True, about='Frame of the pose: origin at node '
                        'start, x forward, z up.')


@dataclass(frozen=True, kw_only=True)
class ApplyConfig:
    """All settings of the node ``odometry``."""

    vehicle: str = setting('', ro=True, about='Name of the vehicle; a calibration of another '
                           'vehicle is refused.')
    levelling: bool = setting(True, ro=True, about='Use the accelerometer for tilt and stops for '
                              'the gyro bias; false: gyros only, as in replay.')
    publish_tf: bool = setting(False, ro=True, about='Publish the pose as TF too: frames.odom -> '
                               'frames.base. Only one node may send this transform.')
    odometer: OdometerConfig = OdometerConfig()
    imu: ImuConfig = ImuConfig()
    start: StartConfig = StartConfig()
    publish: RateConfig = RateConfig()
    frames: OdomFrames = OdomFrames()
