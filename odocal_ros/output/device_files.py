# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Wheel settings for positioning systems with a wheel input."""

import textwrap
from typing import Any

from odocal_ros.calib.result import Calibration
from odocal_ros.output.figures import inverse, known, with_sigma
from odocal_ros.output.file_head import head
from odocal_ros.settings.config import Config

DEVICES = 'wheel_input.txt'
MICRO = 1e6    # definition: millionths in 1


def devices(calibration: Calibration, config: Config, content: dict[str, Any]) -> dict[str, str]:
    """Return the file by name; nothing without a scale factor in metres per pulse."""
    scale = known(calibration.estimates, 'scale_factor')
    if scale.value is None or scale.unit != 'm/pulse':
        return {}
    micrometres = with_sigma(scale.value, scale.sigma, MICRO)
    lines = [head(calibration, content).rstrip(),
             '# for receivers and inertial systems that count the wheel themselves; the pulse is '
             'that of the',
             '# counter calibrated: a device that counts other edges needs a multiple',
             f'# one pulse: {micrometres} um; {inverse(scale)}']
    for where, setting in _settings(scale.value, config.wheels.pulses_per_revolution):
        lines += ['', *textwrap.wrap(where, 98, initial_indent='# ', subsequent_indent='# ')]
        lines += [setting] if setting else []
    return {DEVICES: '\n'.join(lines) + '\n'}


def _settings(scale: float, pulses: float) -> list[tuple[str, str]]:
    """Return (where it goes, the line) for each system; a line is empty where it lacks a fact."""
    per_metre = f'{1 / scale:.9g}'
    wheel = ''
    if pulses and pulses == round(pulses):
        wheel = f'SETWHEELPARAMETERS {pulses:.0f} {pulses * scale:.9g} {scale:.9g}'
    return [
        ('u-blox F9 dead reckoning (UBX-CFG-VALSET, key 0x40070007, U4): whole um per tick',
         f'CFG-SFODO-FACTOR = {scale * MICRO:.0f}'),
        ('SBG Systems, sbg_ros2_driver with device configuration by ROS parameters: group odom; '
         'with the sbgECom library: member gain of SbgEComOdoConf, sent by '
         'sbgEComCmdOdoSetConf: pulses per metre',
         f'gain: {per_metre}' if '.' in per_metre else f'gain: {per_metre}.0'),
        ('OxTS, NAVconfig, advanced tools, tab Wheel speed input: pulses per metre',
         f'Pulses per metre = {per_metre}'),
        ('NovAtel SPAN, firmware up to 7.06: ticks per revolution, circumference m, spacing of '
         'ticks m. Later firmware (DMICONFIG) takes no size; it estimates it.'
         + ('' if wheel else ' Needs a whole number in wheels.pulses_per_revolution.'), wheel)]
