# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The wheel of a calibration for ros2_controllers, and for devices with a wheel input."""

from math import tau
import textwrap
from typing import Any

from odocal_ros.calib.result import Calibration
from odocal_ros.output.figures import inverse, known, with_sigma
from odocal_ros.output.file_head import head
from odocal_ros.outside.yaml_text import parameters
from odocal_ros.settings.config import Config, DIFFERENTIAL, HOLONOMIC, MECANUM, OMNI, SKID
from odocal_ros.settings.nominal import nominal_scale

CONTROLLERS = 'ros2_controllers.yaml'
# controllers that take the radius itself, and their parameter for it
RADIUS = {'ackermann_steering_controller': 'traction_wheels_radius',
          'tricycle_steering_controller': 'traction_wheels_radius',
          'bicycle_steering_controller': 'traction_wheel_radius',
          'tricycle_controller': 'wheel_radius'}
# their parameters for radius and rotation lever
HOLONOMIC_KEYS = {
    MECANUM: ('wheels_radius', 'sum_of_robot_center_projection_on_X_Y_axis'),
    OMNI: ('wheel_radius', 'robot_radius')}
DEVICES = 'wheel_input.txt'
MICRO = 1e6    # definition: millionths in 1


def controllers(calibration: Calibration, config: Config,
                content: dict[str, Any]) -> dict[str, str]:
    """Return the file by name, nothing when no value of it was determined."""
    blocks = _blocks(calibration, config)
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


def _blocks(calibration: Calibration, config: Config) -> dict[str, dict[str, Any]]:
    """Return the parameters by controller, of those that fit the drive."""
    radius = wheel_radius(calibration, config)
    if config.odometer.drive in HOLONOMIC:
        lever = known(calibration.estimates, 'rotation_lever').value
        keys = HOLONOMIC_KEYS[config.odometer.drive]
        own = {key: value for key, value in zip(keys, (radius, lever), strict=True)
               if value is not None}
        if not own:
            return {}
        if config.odometer.drive == MECANUM:
            return {'mecanum_drive_controller': {'kinematics': own}}
        return {'omni_wheel_drive_controller': {
            'wheel_offset': config.odometer.wheel_offset, **own}}
    multipliers = _multipliers(calibration, config)
    blocks: dict[str, dict[str, Any]] = (
        {'diff_drive_controller': multipliers} if multipliers else {})
    if radius is not None and config.odometer.drive == DIFFERENTIAL:
        blocks |= {name: {key: radius} for name, key in RADIUS.items()}
    return blocks


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
    elif width.value is not None and config.odometer.drive == SKID:
        out['wheel_separation'] = width.value       # in place of the distance of the wheels
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
    for where, setting in _device_settings(scale.value, config.wheels.pulses_per_revolution):
        lines += ['', *textwrap.wrap(where, 98, initial_indent='# ', subsequent_indent='# ')]
        lines += [setting] if setting else []
    return {DEVICES: '\n'.join(lines) + '\n'}


def _device_settings(scale: float, pulses: float) -> list[tuple[str, str]]:
    """Return (where it goes, the line) for each system; a line is empty where it lacks a fact."""
    per_metre = f'{1 / scale:.9g}'
    wheel, radius = '', ''
    if pulses and pulses == round(pulses):
        wheel = f'SETWHEELPARAMETERS {pulses:.0f} {pulses * scale:.9g} {scale:.9g}'
        radius = f'WENC_RADIUS {pulses * scale / tau:.7g}'
    needed = 'Needs a whole number in wheels.pulses_per_revolution.'
    return [
        ('u-blox F9 dead reckoning (UBX-CFG-VALSET, key 0x40070007, U4): whole um per tick, '
         f'rounded by up to {0.5 / scale:.2g} ppm',
         f'CFG-SFODO-FACTOR = {scale * MICRO:.0f}'),
        ('SBG Systems, sbg_ros2_driver with device configuration by ROS parameters: group odom; '
         'with the sbgECom library: member gain of SbgEComOdoConf, sent by '
         'sbgEComCmdOdoSetConf: pulses per metre',
         f'gain: {per_metre}' if '.' in per_metre else f'gain: {per_metre}.0'),
        ('OxTS, NAVconfig, advanced tools, tab Wheel speed input: pulses per metre',
         f'Pulses per metre = {per_metre}'),
        ('NovAtel SPAN, firmware up to 7.06: ticks per revolution, circumference m, spacing of '
         'ticks m. Later firmware (DMICONFIG) takes no size; it estimates it.'
         + ('' if wheel else f' {needed}'), wheel),
        ('ArduPilot rover: wheel radius m, '
         + (f'for WENC_CPR {pulses:.0f}' if radius else f'for WENC_CPR. {needed}'), radius)]
