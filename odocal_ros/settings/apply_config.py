# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Settings of the node ``odometry``: those of the calibrator's inputs, and a few of its own."""

from dataclasses import dataclass

from odocal_ros.settings.config import ImuConfig, NAN, OdometerConfig
from odocal_ros.settings.setting import setting


@dataclass(frozen=True, kw_only=True)
class StartConfig:
    attitude: tuple[float, ...] = setting((), 'x, y, z, w', -1.0, 1.0, ro=True, about=(
        'Attitude of the Imu (its body frame b) in the odom frame at the first message, from '
        'another system; empty: level by the accelerometer, the vehicle heads along x.'))
    gyro_bias: tuple[float, ...] = setting((0.0, 0.0, 0.0), 'rad/s', -1.0, 1.0, ro=True, about=(
        'Gyro bias in b that goes with the attitude given.'))
    latitude: float = setting(NAN, 'deg', -90.0, 90.0, ro=True, about='Where the attitude given '
                              "is east-north-up: the Earth's turn is then taken out of the turn "
                              'rates; NaN: it stays in the gyro bias seen at rest.')


@dataclass(frozen=True, kw_only=True)
class RateConfig:
    rate: float = setting(20.0, 'Hz', 1.0, 200.0, ro=True, about='Highest rate of the messages '
                          'sent; twists are means over the time since the one before.')


@dataclass(frozen=True, kw_only=True)
class OdomFrames:
    base: str = setting('base_link', ro=True, frame=True, about='Vehicle frame: of the twist, '
                        'and child frame of the odometry.')
    odom: str = setting('odom', ro=True, frame=True, about='Frame of the pose: where the node '
                        'began, x forward, z up.')


@dataclass(frozen=True, kw_only=True)
class ApplyConfig:
    """All settings of the node ``odometry``."""

    vehicle: str = setting('', ro=True, about='Which vehicle this is, in any words: the '
                           'calibration of another one is refused.')
    levelling: bool = setting(True, ro=True, about='Tilt is held by the accelerometer, gyro bias '
                              'by stops; false: gyros alone from the start, as replay reckons.')
    odometer: OdometerConfig = OdometerConfig()
    imu: ImuConfig = ImuConfig()
    start: StartConfig = StartConfig()
    publish: RateConfig = RateConfig()
    frames: OdomFrames = OdomFrames()
