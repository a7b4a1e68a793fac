# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files for drivers, controllers and filters: wheel radius, wheel noise, errors of the IMU."""

from collections.abc import Mapping
import math
import textwrap
from typing import Any, TYPE_CHECKING

import numpy as np

from odocal_ros.calib.result import Calibration
from odocal_ros.output.summary import sentence
from odocal_ros.output.value_text import counted, finite_estimate, inverse_text, with_sigma
from odocal_ros.safe_io.text_formats import for_comment, one_line, parameter_block
from odocal_ros.settings.config import Config, DIFFERENTIAL, HOLONOMIC, MECANUM, OMNI, SIDES, SKID
from odocal_ros.settings.levels import INFORMED_SHARE
from odocal_ros.settings.nominal import nominal_scale

if TYPE_CHECKING:
    from odocal_ros.estimator.result.odometry_output import TwistNoise

CONTROLLERS = 'ros2_controllers.yaml'
# controllers whose parameter is the radius, not a multiplier
RADIUS = {'ackermann_steering_controller': 'traction_wheels_radius',
          'tricycle_steering_controller': 'traction_wheels_radius',
          'bicycle_steering_controller': 'traction_wheel_radius',
          'tricycle_controller': 'wheel_radius'}
# parameters for radius and rotation lever
HOLONOMIC_KEYS = {
    MECANUM: ('wheels_radius', 'sum_of_robot_center_projection_on_X_Y_axis'),
    OMNI: ('wheel_radius', 'robot_radius')}
DEVICES = 'wheel_input.txt'
MICRO = 1e6    # definition: millionths in 1
TWIST, IMU_ERRORS = 'wheel_odometry_covariance.yaml', 'imu_errors.yaml'
UNKNOWN = 1e6      # definition: variance of unmeasured components, as in ROS drivers
# comments of the files
FOR_CONTROLLERS = """\
# for ros2_controllers: copy the block of your controller into its parameter file,
# under the name of your controller; the calibrated wheel must be one
# that the controller drives. The multipliers are relative to odometer.nominal_scale:
# if other multipliers were active during the drive, multiply them by these.
# Older releases call the radius rear_wheels_radius or rear_wheel_radius.
"""
FOR_DEVICES = """\
# for receivers and inertial systems that count the wheel themselves; the pulse is that of the
# counter calibrated: a device that counts other edges needs a multiple
"""
FOR_TWIST = """\
# Covariance of the twist of the calibrated wheels in {base}, for one message per
# {period:.4g} s of the odometer. Estimated from this calibration: reading error, wheel noise,
# scale, track width and their sigmas. Not included: an odometer delay, later tyre changes.
# Velocity (m/s)^2, turn rate (rad/s)^2; order x, y, z, about x, y, z. {unknown:g}: not measured.
# robot_localization reads it from the messages: copy the diagonal into elements 0, 7, 14, 21,
# 28, 35 of twist.covariance of your driver, or its table below if the driver knows the speed.
# ros2_controllers: copy the line under the name of your controller.
"""
FOR_IMU_ERRORS = """\
# Errors of the IMU that this calibration determined better than the prior; of several legs the
# value with the smallest sigma. Axes: the IMU turned by imu.mounting_rpy (none: its own), after
# imu.gyro_scale and imu.accel_scale. True value = reading - bias - scale * reading, and for
# axis_ab - axis_ab * reading b in axis a. rad/s, m/s^2, rad; scale without a unit. Biases are
# those at the start of the leg: they change with temperature and at every start.
"""


def controllers(calibration: Calibration, config: Config,
                content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text, empty if none of its values is determined."""
    blocks = ''.join(parameter_block(values, name)
                     for name, values in _blocks(calibration, config).items())
    origin = origin_comment(calibration, content)
    return {CONTROLLERS: origin + FOR_CONTROLLERS + blocks} if blocks else {}


def _blocks(calibration: Calibration, config: Config) -> dict[str, dict[str, Any]]:
    """Return controller -> parameters, for the controllers of this drive (odometer.drive)."""
    radius = wheel_radius(calibration, config)
    if config.odometer.drive in HOLONOMIC:
        lever = finite_estimate(calibration.estimates, 'rotation_lever').value
        keys = HOLONOMIC_KEYS[config.odometer.drive]
        values = {key: value for key, value in zip(keys, (radius, lever), strict=True)
                  if value is not None}
        if not values:
            return {}
        if config.odometer.drive == MECANUM:
            return {'mecanum_drive_controller': {'kinematics': values}}
        return {'omni_wheel_drive_controller': {
            'wheel_offset': config.odometer.wheel_offset, **values}}
    multipliers = _multipliers(calibration, config)
    blocks: dict[str, dict[str, Any]] = (
        {'diff_drive_controller': multipliers} if multipliers else {})
    if radius is not None and config.odometer.drive == DIFFERENTIAL:
        blocks |= {name: {key: radius} for name, key in RADIUS.items()}
    return blocks


def _multipliers(calibration: Calibration, config: Config) -> dict[str, float]:
    """Return the multipliers of diff_drive_controller, by wheel if these are estimated."""
    estimates = calibration.estimates
    common = finite_estimate(estimates, 'scale_ratio').value
    left, right = (finite_estimate(estimates, f'scale_factor_{side}') for side in SIDES)
    nominal = nominal_scale(config, left.unit or finite_estimate(estimates, 'scale_factor').unit)
    ratios = [common, common]
    if nominal and left.value is not None and right.value is not None:
        ratios = [left.value / nominal, right.value / nominal]
    multipliers = {f'{side}_wheel_radius_multiplier': ratio
                   for side, ratio in zip(SIDES, ratios, strict=True) if ratio is not None}
    width = finite_estimate(estimates, 'track_width')
    if width.value is not None and width.sigma and config.odometer.track_width:
        multipliers['wheel_separation_multiplier'] = width.value / config.odometer.track_width
    elif width.value is not None and config.odometer.drive == SKID:
        multipliers['wheel_separation'] = width.value      # effective, not between the wheels
    return multipliers


def wheel_radius(calibration: Calibration, config: Config) -> float | None:
    """Return the effective radius of the wheel, m; None if its pulses per turn are unknown."""
    scale = finite_estimate(calibration.estimates, 'scale_factor')
    wheels = config.wheels
    if scale.value is None:
        return None
    if scale.unit == 'm/rad':
        return scale.value
    if scale.unit == 'm/pulse' and wheels.pulses_per_revolution:
        return scale.value * wheels.pulses_per_revolution / math.tau
    if scale.unit == '1' and wheels.radius:     # a speed computed with that radius
        return scale.value * wheels.radius
    return None


def devices(calibration: Calibration, config: Config, content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text, empty without a scale factor in metres per pulse."""
    scale = finite_estimate(calibration.estimates, 'scale_factor')
    if scale.value is None or scale.unit != 'm/pulse':
        return {}
    micrometres = with_sigma(scale.value, scale.sigma, MICRO)
    lines = [f'# one pulse: {micrometres} um; {inverse_text(scale)}']
    for description, setting in _device_settings(scale.value, config.wheels.pulses_per_revolution):
        lines += ['', *textwrap.wrap(description, 98, initial_indent='# ',
                                     subsequent_indent='# ')]
        lines += [setting] * bool(setting)
    return {DEVICES: origin_comment(calibration, content) + FOR_DEVICES
            + '\n'.join(lines) + '\n'}


def _device_settings(scale: float, pulses: float) -> list[tuple[str, str]]:
    """Return (description, setting) for each system; a setting without its data is empty."""
    per_metre = f'{1 / scale:.9g}'
    wheel, radius = '', ''
    if pulses and pulses == round(pulses):
        wheel = f'SETWHEELPARAMETERS {pulses:.0f} {pulses * scale:.9g} {scale:.9g}'
        radius = f'WENC_RADIUS {pulses * scale / math.tau:.7g}'
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


def wheel_covariance(calibration: Calibration, config: Config,
                     content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text, empty without a scale factor of the smoother."""
    from odocal_ros.estimator.result.odometry_output import twist_noise
    noise = twist_noise(calibration)
    if noise is None:
        return {}
    variances = noise.variances(noise.speed, noise.turn_rate)
    density = math.sqrt(variances[0] * noise.period)
    text = FOR_TWIST.format(base=config.frames.base, period=noise.period, unknown=UNKNOWN)
    if not noise.has_turn_rate:
        text += '# Without a left and a right wheel the turn rate is not measured: use a gyro.\n'
    text += ('# VIO with wheels (VINS-Fusion forks), m/s per sqrt(Hz):\n'
             f'#   wheel_velocity_noise_sigma: {density:.3g}\n')
    diagonal = {'twist_covariance_diagonal': _diagonal(variances)}
    return {TWIST: origin_comment(calibration, content) + text
            + parameter_block(diagonal, 'diff_drive_controller') + _table(noise)}


def _diagonal(variances: np.ndarray[Any, Any]) -> list[float]:
    """Return the diagonal of a twist covariance from variances forward, left, up, turn rate."""
    forward, left, up, turn = (float(f'{x:.3g}') for x in np.nan_to_num(variances, nan=UNKNOWN))
    return [forward, left, up, UNKNOWN, UNKNOWN, turn]


def _table(noise: 'TwistNoise') -> str:
    """Return the variances at several speeds and turn rates, as parameters of a custom node."""
    speed_count, rate_count = 6, 4
    speeds = np.linspace(0.0, noise.fastest[0], speed_count)
    rates = np.linspace(0.0, noise.fastest[1], rate_count)
    rows = {f'turn_rate_{k}': {
        'rad_per_s': float(f'{rate:.3g}')} | {
        name: [float(f'{noise.variances(speed, rate)[column]:.3g}') for speed in speeds]
        for name, column in (('x', 0), ('y', 1), *[('yaw', 3)] * noise.has_turn_rate)}
        for k, rate in enumerate(rates)}
    return parameter_block({'period': float(f'{noise.period:.4g}'),
                            'speed': [float(f'{speed:.3g}') for speed in speeds], **rows},
                           'wheel_odometry_covariance')


def imu_errors(calibration: Calibration, config: Config,
               content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text, empty if no IMU error is known better than its prior."""
    best: dict[str, dict[str, float]] = {}
    for leg in calibration.legs:
        method = leg.methods.get('smoother')
        if method is None or leg.verdict.value == 'rejected':
            continue
        for name, entry in _imu_errors_of(method.details).items():
            if name not in best or entry['sigma'] < best[name]['sigma']:
                best[name] = entry
    for axis in 'xyz':
        bias = calibration.estimates.get(f'gyro_bias_{axis}')
        if bias is not None and bias.value is not None and bias.sigma is not None:
            best[f'gyro_bias_{axis}'] = {'value': bias.value, 'sigma': bias.sigma}
    if not best:
        return {}
    return {IMU_ERRORS: origin_comment(calibration, content) + FOR_IMU_ERRORS
            + parameter_block(dict(sorted(best.items())), 'imu_errors')}


def _imu_errors_of(details: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return value and sigma of the IMU errors that a leg determined, by name."""
    from odocal_ros.estimator.state import CONSTANTS
    ratio = details.get('posterior_to_prior', {})
    errors = {name: details[name] for name in CONSTANTS
              if name.startswith(('gyro_', 'accelerometer_')) and name in details
              and ratio.get(name, 1.0) < INFORMED_SHARE}
    errors |= {f'accelerometer_bias_{axis}': bias
               for axis, bias in details.get('accelerometer_bias', {}).items()
               if bias['ratio'] < INFORMED_SHARE}
    return {name: {key: entry[key] for key in ('value', 'sigma')}
            for name, entry in errors.items()}


def origin_comment(calibration: Calibration, content: dict[str, Any]) -> str:
    """Return ``origin_text`` as comment lines."""
    return for_comment(origin_text(calibration, content))


def origin_text(calibration: Calibration, content: dict[str, Any]) -> str:
    """Return two lines on a file: its software, date, legs and bags; the result."""
    inputs = content['inputs']
    bags = ', '.join(str(entry['bag']) for entry in inputs if entry.get('bag')) or 'live'
    bags += ''.join(f', node {entry["node"]}' for entry in inputs if entry.get('node'))
    bags += f', vehicle {content["vehicle"]}' if content.get('vehicle') else ''
    return (f'{content["software"]}, {content["created"]}, '
            f'{counted(len(calibration.legs), "leg")}, from: {one_line(bags)}\n'
            f'{sentence(calibration)}')
