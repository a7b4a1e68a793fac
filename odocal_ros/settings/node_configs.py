# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of the nodes odometry and drive_pattern."""

from dataclasses import dataclass

from odocal_ros.settings.config import ImuConfig, NAN, OdometerConfig
from odocal_ros.settings.setting import setting

POSES = ('geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PoseWithCovarianceStamped',
         'nav_msgs/msg/Odometry')


@dataclass(frozen=True, kw_only=True)
class StartConfig:
    attitude: tuple[float, ...] = setting((), 'x, y, z, w', -1.0, 1.0, read_only=True, about=(
        'Attitude of the IMU (body frame b) in the odom frame at the first message, from another '
        'system; empty: levelled by the accelerometer, heading along x.'))
    gyro_bias: tuple[float, ...] = setting((0.0, 0.0, 0.0), 'rad/s', -1.0, 1.0, read_only=True,
                                           about='Gyro bias in body frame b that belongs to '
                                           'start.attitude.')
    latitude: float = setting(NAN, 'deg', -90.0, 90.0, read_only=True, about=(
        'Latitude, if the attitude is given in east-north-up: the Earth rate is removed from '
        'the turn rates. NaN: it remains in the gyro bias measured at rest.'))


@dataclass(frozen=True, kw_only=True)
class RateConfig:
    rate: float = setting(20.0, 'Hz', 1.0, 200.0, read_only=True, about='Highest publishing rate; '
                          'twists are means since the previous message.')


@dataclass(frozen=True, kw_only=True)
class OdomFrames:
    base: str = setting('base_link', read_only=True, frame=True, about=(
        'Vehicle frame: frame of the twist and child frame of the odometry.'))
    odom: str = setting('odom', read_only=True, frame=True, about=(
        'Frame of the pose: origin at node start, x forward, z up.'))


@dataclass(frozen=True, kw_only=True)
class ApplyConfig:
    """All settings of the node ``odometry``."""

    vehicle: str = setting('', read_only=True, about=(
        'Name of the vehicle; a calibration of another vehicle is refused.'))
    levelling: bool = setting(True, read_only=True, about=(
        'Correct the tilt by the accelerometer, and the gyro bias at standstill; false: gyros '
        'only, as in replay.'))
    publish_tf: bool = setting(False, read_only=True, about=(
        'Publish the pose as TF too: frames.odom -> frames.base. Only one node may send this '
        'transform.'))
    odometer: OdometerConfig = OdometerConfig()
    imu: ImuConfig = ImuConfig()
    start: StartConfig = StartConfig()
    publish: RateConfig = RateConfig()
    frames: OdomFrames = OdomFrames()


@dataclass(frozen=True, kw_only=True)
class PatternConfig:
    """All settings of the node ``drive_pattern``."""

    speed: float = setting(NAN, 'm/s', 0.01, 2.0, read_only=True, about='Speed limit. Required.')
    rectangle: tuple[float, ...] = setting((), 'm', -1e4, 1e4, read_only=True, about=(
        'Free area in the frame of the pose: x and y of one corner, x and y of the opposite one. '
        'Required. The robot stops when the pose leaves it.'))
    pattern: str = setting('square', read_only=True, about=(
        'straight: back and forth, with half turns on the spot; square: around to the left, '
        'then to the right, with rests on the corners; figure_eight: a circle to the left and '
        'one to the right.'), choices=('straight', 'square', 'figure_eight'))
    rounds: int = setting(1, '', 1, 100, read_only=True, about='Repetitions of the pattern.')
    margin: float = setting(0.5, 'm', 0.0, 100.0, read_only=True, about=(
        'Distance of the pattern from the edges of the rectangle.'))
    turn_rate: float = setting(0.5, 'rad/s', 0.05, 3.0, read_only=True, about='Largest turn rate.')
    acceleration: float = setting(0.3, 'm/s^2', 0.01, 5.0, read_only=True, about=(
        'Largest acceleration, and deceleration to a rest.'))
    rest: float = setting(3.0, 's', 0.0, 60.0, read_only=True, about='Duration of the rest '
                          'at the end of each straight.')
    timeout: float = setting(600.0, 's', 1.0, 7200.0, read_only=True, about='Largest '
                             'duration of the pattern; the robot then stops.')
    pose_type: str = setting(POSES[0], read_only=True, choices=POSES, about=(
        'Message type of the topic pose: the pose of base_link.'))
    stamped: bool = setting(False, read_only=True, about=(
        'Publish cmd_vel as geometry_msgs/TwistStamped instead of Twist.'))
