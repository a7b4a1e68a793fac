# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files of noises for drivers and filters: covariance of the wheel twist, errors of the IMU."""

from collections.abc import Mapping
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from odocal_ros.calib.result import Calibration
from odocal_ros.output.file_head import head
from odocal_ros.outside.yaml_text import parameters
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import INFORMED_SHARE

if TYPE_CHECKING:
    from odocal_ros.estimator.result.twist_noise import TwistNoise

TWIST, IMU_ERRORS = 'wheel_odometry_covariance.yaml', 'imu_errors.yaml'
UNKNOWN = 1e6      # definition: variance of what wheels do not measure, as ROS drivers have it


def wheel_covariance(calibration: Calibration, config: Config,
                     content: dict[str, Any]) -> dict[str, str]:
    """Return the file by name; nothing without a scale factor of the smoother."""
    from odocal_ros.estimator.result.twist_noise import twist_noise
    noise = twist_noise(calibration)
    if noise is None:
        return {}
    usual = noise.variances(noise.speed, noise.turn_rate)
    density = math.sqrt(usual[0] * noise.period)
    lines = [
        head(calibration, content).rstrip(),
        f'# Covariance of the twist of the calibrated wheels in {config.frames.base}, for one '
        'message per',
        f'# {noise.period:.4g} s of the odometer. Estimated from this calibration: reading '
        'error, wheel noise,',
        '# scale, track width and their sigmas. Not included: an odometer delay, later tyre '
        'changes.',
        '# Velocity (m/s)^2, turn rate (rad/s)^2; order x, y, z, about x, y, z. '
        f'{UNKNOWN:g}: not measured.',
        '# robot_localization reads it from the messages: copy the diagonal into elements 0, 7, '
        '14, 21,',
        '# 28, 35 of twist.covariance of your driver, or its table below if the driver knows the '
        'speed.',
        '# ros2_controllers: copy the line under the name of your controller.',
        *([] if noise.has_turn_rate else [
            '# Without a left and a right wheel the turn rate is not measured: use a gyro.']),
        '# VIO with wheels (VINS-Fusion forks), m/s per sqrt(Hz):',
        f'#   wheel_velocity_noise_sigma: {density:.3g}']
    diagonal = {'twist_covariance_diagonal': _diagonal(usual)}
    text = '\n'.join(lines) + '\n'
    return {TWIST: text + parameters(diagonal, 'diff_drive_controller') + _table(noise)}


def _diagonal(variances: np.ndarray[Any, Any]) -> list[float]:
    """Return the diagonal of a twist covariance from variances forward, left, up, turn rate."""
    forward, left, up, turn = (float(f'{x:.3g}') for x in np.nan_to_num(variances, nan=UNKNOWN))
    return [forward, left, up, UNKNOWN, UNKNOWN, turn]


def _table(noise: 'TwistNoise') -> str:
    """Return the variances by speed and turn rate, as parameters of a node of one's own."""
    speeds = np.linspace(0.0, noise.fastest[0], 6)
    rates = np.linspace(0.0, noise.fastest[1], 4)
    rows = {f'turn_rate_{k}': {
        'rad_per_s': float(f'{rate:.3g}')} | {
        name: [float(f'{noise.variances(v, rate)[column]:.3g}') for v in speeds]
        for name, column in (('x', 0), ('y', 1), ('yaw', 3)) if column < 3 or noise.has_turn_rate}
        for k, rate in enumerate(rates)}
    return parameters({'period': float(f'{noise.period:.4g}'),
                       'speed': [float(f'{v:.3g}') for v in speeds], **rows},
                      'wheel_odometry_covariance')


def imu_errors(calibration: Calibration, config: Config,
               content: dict[str, Any]) -> dict[str, str]:
    """Return the file by name; nothing if no error of the IMU is known better than its prior."""
    found: dict[str, dict[str, float]] = {}
    for leg in calibration.legs:
        method = leg.methods.get('smoother')
        if method is None or leg.verdict.value == 'rejected':
            continue
        for name, entry in _known(method.details).items():
            if name not in found or entry['sigma'] < found[name]['sigma']:
                found[name] = entry
    for axis in 'xyz':
        bias = calibration.estimates.get(f'gyro_bias_{axis}')
        if bias is not None and bias.value is not None and bias.sigma is not None:
            found[f'gyro_bias_{axis}'] = {'value': bias.value, 'sigma': bias.sigma}
    if not found:
        return {}
    lines = [
        head(calibration, content).rstrip(),
        '# Errors of the IMU that this calibration determined better than the prior; of several '
        'legs the',
        '# value with the smallest sigma. Axes: the IMU turned by imu.mounting_rpy (none: its '
        'own), after',
        '# imu.gyro_scale and imu.accel_scale. True value = reading - bias - scale * reading, and '
        'for axis_ab',
        '# - axis_ab * reading b in axis a. rad/s, m/s^2, rad; scale without a unit. Biases are '
        'those at the',
        '# start of the leg: they change with temperature and at every start.']
    text = '\n'.join(lines) + '\n'
    return {IMU_ERRORS: text + parameters(dict(sorted(found.items())), 'imu_errors')}


def _known(details: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the errors of the IMU that a leg determined, by name."""
    from odocal_ros.estimator.state import CONSTANTS
    ratio = details.get('posterior_to_prior', {})
    found = {name: {key: details[name][key] for key in ('value', 'sigma')} for name in CONSTANTS
             if name.startswith(('gyro_', 'accelerometer_')) and name in details
             and ratio.get(name, 1.0) < INFORMED_SHARE}
    biases = details.get('accelerometer_bias', {})
    return found | {f'accelerometer_bias_{axis}': {key: one[key] for key in ('value', 'sigma')}
                    for axis, one in biases.items() if one['ratio'] < INFORMED_SHARE}
