# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Parameters of the drive controllers of ros2_controllers, from a calibration."""

from math import tau
from typing import Any

from odocal_ros.calib.result import Calibration
from odocal_ros.output.figures import known
from odocal_ros.output.file_head import head
from odocal_ros.outside.yaml_text import parameters
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import nominal_scale

CONTROLLERS = 'ros2_controllers.yaml'
# controllers that take the radius itself, and their parameter for it
RADIUS = {'ackermann_steering_controller': 'traction_wheels_radius',
          'tricycle_steering_controller': 'traction_wheels_radius',
          'bicycle_steering_controller': 'traction_wheel_radius',
          'tricycle_controller': 'wheel_radius'}


def controllers(calibration: Calibration, config: Config,
                content: dict[str, Any]) -> dict[str, str]:
    """Return the file by name, nothing when no value of it was determined."""
    blocks = {}
    multipliers = _multipliers(calibration, config)
    if multipliers:
        blocks['diff_drive_controller'] = multipliers
    radius = wheel_radius(calibration, config)
    if radius is not None:
        blocks |= {name: {key: radius} for name, key in RADIUS.items()}
    if not blocks:
        return {}
    lines = [head(calibration, content).rstrip(),
             '# for ros2_controllers: copy the block of your controller into its parameter file,',
             '# under the name of your controller; the calibrated wheel must be one',
             '# that the controller drives. The multipliers are relative to '
             'odometer.nominal_scale:',
             '# if other multipliers were active during the drive, multiply them by these.',
             '# Older releases call the radius rear_wheels_radius or rear_wheel_radius.']
    text = '\n'.join(lines) + '\n'
    return {CONTROLLERS: text + ''.join(parameters(v, name) for name, v in blocks.items())}


def _multipliers(calibration: Calibration, config: Config) -> dict[str, float]:
    """Return those of diff_drive_controller: each wheel's own factor where there is one."""
    estimates = calibration.estimates
    common = known(estimates, 'scale_ratio').value
    left, right = (known(estimates, f'scale_factor_{side}') for side in ('left', 'right'))
    nominal = nominal_scale(config, left.unit or known(estimates, 'scale_factor').unit)
    out = {}
    if nominal and left.value is not None and right.value is not None:
        out = {'left_wheel_radius_multiplier': left.value / nominal,
               'right_wheel_radius_multiplier': right.value / nominal}
    elif common is not None:
        out = {f'{name}_wheel_radius_multiplier': common for name in ('left', 'right')}
    width = known(estimates, 'track_width')
    if width.value is not None and width.sigma and config.odometer.track_width:
        out['wheel_separation_multiplier'] = width.value / config.odometer.track_width
    return out


def wheel_radius(calibration: Calibration, config: Config) -> float | None:
    """Return the effective radius of the wheel, m; None where its pulses per turn are unknown."""
    scale = known(calibration.estimates, 'scale_factor')
    wheels = config.wheels
    if scale.value is None:
        return None
    if scale.unit == 'm/rad':
        return scale.value
    if scale.unit == 'm/pulse' and wheels.pulses_per_revolution:
        return scale.value * wheels.pulses_per_revolution / tau
    if scale.unit == '1' and wheels.radius:     # a speed made with that radius
        return scale.value * wheels.radius
    return None
