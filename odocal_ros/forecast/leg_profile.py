# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a recorded leg was driven like: the profile from which its sigmas are predicted."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadData
from odocal_ros.forecast.planned_drive import DRIVE_STEP, PlannedDrive, REST_SPEED
from odocal_ros.nav.integral import running_integral
from odocal_ros.nav.standstill import standstills
from odocal_ros.screening.inputs import Inputs, place, Placed
from odocal_ros.settings.config import Config


def profile_of(inputs: Inputs, config: Config) -> PlannedDrive:
    """
    Return a leg as a drive: speed by the odometer, direction by the gyro, first course by fixes.

    Raises
    ------
    BadData
        IMU, odometer or fixes are missing.
    BadUsage
        The vehicle did not move.

    """
    if not (len(inputs.t_imu) > 3 and len(inputs.travel.t) > 1 and len(inputs.t_fix)):
        raise BadData('a profile needs IMU, odometer and fixes between the marks; check the bag '
                      'with odocal inspect')
    placed = _placed(inputs, config)
    origin, scale = placed.origin, placed.rough
    first, last = max(inputs.t_imu[0], inputs.travel.t[0]), min(
        inputs.t_stop, inputs.t_imu[-1], inputs.travel.t[-1])
    step = max(DRIVE_STEP, (last - first) / 5e4)
    t = np.linspace(first, last, max(2, int((last - first) / step)))
    spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, scale, config.leg.standstill)
    resting = np.any([(t >= a) & (t <= b) for a, b in spans], axis=0) if len(spans) \
        else np.zeros(len(t), bool)
    profile_window = 0.5    # s each side that a speed is taken over
    path_length = inputs.travel.at(t + profile_window) - inputs.travel.at(t - profile_window)
    speed = np.where(resting, 0.0, path_length * scale / (2 * profile_window))
    speed[~resting & (np.abs(speed) <= REST_SPEED)] = 2 * REST_SPEED   # too short to count as rest
    yaw = _yaw(inputs, spans, t)
    return PlannedDrive(t, speed, yaw + _first_course(t, speed, yaw, inputs.t_fix, placed.fixes_n),
                        np.zeros_like(t), origin.latitude, origin.longitude, origin.height)


def _placed(inputs: Inputs, config: Config) -> Placed:
    """Return the fix positions and the metres per count; raise BadData without them."""
    placed = place(inputs, config)
    if not placed.rough:
        raise BadData('the scale is not known yet: the fixes moved too little and '
                      'odometer.nominal_scale is not set')
    return placed


def count_size(inputs: Inputs, config: Config) -> float:
    """
    Return the metres of one count of the odometer, 0 for speeds.

    Raises
    ------
    BadData
        The scale is not known.

    """
    return inputs.travel.quantum * _placed(inputs, config).rough


def _yaw(inputs: Inputs, spans: Floats, t: Floats) -> Floats:
    """Return the angle turned about the vertical by each time, rad; rate at rest taken out."""
    t_imu, w = inputs.t_imu, inputs.w_b[:, 2]
    at_rest = np.any([(t_imu >= a) & (t_imu <= b) for a, b in spans], axis=0) if len(spans) \
        else np.zeros(len(t_imu), bool)
    w = w - (w[at_rest].mean() if at_rest.any() else 0.0)
    return np.interp(t, t_imu, running_integral(t_imu, w))


def _first_course(t: Floats, speed: Floats, yaw: Floats, t_fix: Floats, fixes_n: Floats) -> float:
    """Return the angle that rotates the track of speed and yaw onto the fixes, rad."""
    step = speed[:-1] * np.diff(t)
    track = np.concatenate([[0.0], np.cumsum(step * np.exp(1j * yaw[:-1]))])
    inside = (t_fix >= t[0]) & (t_fix <= t[-1])
    if inside.sum() < 2:
        return 0.0
    at = np.interp(t_fix[inside], t, track.real) + 1j * np.interp(t_fix[inside], t, track.imag)
    fixed = fixes_n[inside, 0] + 1j * fixes_n[inside, 1]
    return float(np.angle(np.sum((fixed - fixed.mean()) * np.conj(at - at.mean()))))


def fix_figures(inputs: Inputs) -> dict[str, float]:
    """Return sigma of one fix, east or north and up, m, and fixes a second, as in ``Sigmas``."""
    inside = (inputs.t_fix >= 0) & (inputs.t_fix <= inputs.t_stop)
    if inside.sum() < 2:
        raise BadData('fewer than two usable fixes between the marks')
    middle = np.median(np.diagonal(inputs.covariance_n[inside], axis1=1, axis2=2), axis=0)
    return {'fix': float(np.sqrt((middle[0] + middle[1]) / 2)),
            'fix_up': float(np.sqrt(middle[2])),
            'fix_rate': float(1 / np.median(np.diff(inputs.t_fix[inside])))}
