# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Forecast of a leg: its sigmas if it ended here, and the remaining distance to the limits.

The vehicle is assumed to stop at its current position and to rest for PREDICTED_REST_S in total.
The forecast is shown to the operator, and is never part of a result.
"""

from collections.abc import Callable
from dataclasses import replace
import math

import numpy as np

from odocal_ros.calib.choice import choose, deciding_methods
from odocal_ros.data.arrays import Ints
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import take
from odocal_ros.forecast import leg_so_far, smoother_forecast
from odocal_ros.forecast.forecast import (
    Forecast,
    LegEnded,
    main_sources,
    ParameterForecast,
    PREDICTED_REST_S,
    UNREACHABLE_TEXT,
)
from odocal_ros.forecast.planned_drive import insert_section, PlannedDrive, REST_SPEED
from odocal_ros.forecast.predict import find_remaining_distance, predict, Prediction, Sigmas
from odocal_ros.forecast.quantities import stated_variance, with_heading
from odocal_ros.screening.leg_kind import missing_force_cause
from odocal_ros.settings.config import Config

DRIVE_ROWS = 1000         # judgement: rows of a drive for a prediction
# judgement: the heading sigma is from the last rows up to this time after the start mark
ORIENTATION_NS, ORIENTATION_ROWS = 10**9, 100
DRIVE_ON = 'drive on with stops, starts and turns'


def drive_on(drive: PlannedDrive, metres: float) -> PlannedDrive:
    """Return the drive extended straight ahead by ``metres`` before its rest, at median speed."""
    moving = np.flatnonzero(np.abs(drive.speed) > REST_SPEED)
    speed = float(np.median(np.abs(drive.speed[moving])))
    t = np.linspace(0.0, metres / speed, 50)[1:]
    return insert_section(drive, int(moving[-1]), t, np.full_like(t, speed), np.zeros_like(t))


def forecast_leg(leg: Leg, fix_rate: float, config: Config,
                 is_needed: Callable[[], bool] = lambda: True,
                 smoother: leg_so_far.SmootherSoFar | None = None) -> Forecast:
    """
    Return the forecast of a leg that ends here, with the faults of its methods so far.

    leg : the data so far; its last row is the current position.   fix_rate : Hz.   config :
    settings at the leg's start.   is_needed : called repeatedly; if False, LegEnded is raised.
    smoother : of this leg; each update starts from the previous one.

    Raises OdocalError: no forecast is possible yet: no motion, no fixes, scale unknown.
    """
    missing_force = missing_force_cause(leg.imu, config.imu.accel_scale)
    running = smoother_forecast.update_running(leg, config, smoother, is_needed)
    only_smoother = deciding_methods(config.method) == smoother_forecast.ONLY_SMOOTHER
    if only_smoother or smoother_forecast.has_all_values(running):     # two_point is not used
        forecast = Forecast(ParameterForecast(None, config.verdict.max_scale_sigma, None),
                            ParameterForecast(None, config.verdict.max_yaw_sigma, None))
    else:
        forecast = _forecast_by_end_points(leg, fix_rate, config, is_needed)
        if smoother is not None and 'smoother' in deciding_methods(config.method):
            forecast = replace(forecast, scale=_or_drive_on(forecast.scale))
            if not missing_force:
                forecast = replace(forecast, yaw=_or_drive_on(forecast.yaw))
    if missing_force:
        forecast = smoother_forecast.without_accelerometer_values(forecast)
    if not is_needed():
        raise LegEnded
    if running is not None:
        forecast = smoother_forecast.add_running_estimate(forecast, running, config)
    estimates, _ = choose(forecast.methods, config.method)
    return replace(forecast, estimates=estimates, until_ns=leg.stop_ns)


def _forecast_by_end_points(leg: Leg, fix_rate: float, config: Config,
                            is_needed: Callable[[], bool]) -> Forecast:
    """Return the two_point forecast of the leg with its end points."""
    inputs = leg_so_far.screen_thinned(leg, config).inputs
    profile = leg_so_far.drive_profile(inputs, config)
    sigmas = Sigmas(config=_with_expected_heading(leg, config),
                    **leg_so_far.fix_and_count_accuracy(inputs, config) | {'fix_rate': fix_rate})
    drive = _with_final_rest(_thin_rows(profile))
    prediction = predict(drive, sigmas)

    def lengthen(drive: PlannedDrive, metres: float) -> PlannedDrive:
        if not is_needed():
            raise LegEnded
        return drive_on(drive, metres)

    def forecast(parameter: str, limit: float, limitation: str = '') -> ParameterForecast:
        sigma = prediction.sigma(parameter)
        metres = 0.0 if sigma is not None and sigma <= limit else None
        if metres is None and not limitation:
            metres = find_remaining_distance(drive, sigmas, parameter, limit, lengthen)
            limitation = UNREACHABLE_TEXT      # printed if metres is None
        return ParameterForecast(sigma, limit, metres,
                                 main_sources(prediction.method, parameter), limitation)

    limits = config.verdict
    return Forecast(
        forecast(smoother_forecast.SCALE, limits.max_scale_sigma),
        forecast(smoother_forecast.YAW, limits.max_yaw_sigma,
                 _yaw_limit_reason(prediction, limits.max_yaw_sigma)),
        prediction.method.estimates[smoother_forecast.PITCH].sigma)


def _or_drive_on(two_point: ParameterForecast) -> ParameterForecast:
    """Return the two_point forecast; with DRIVE_ON, for the smoother, if it misses the limit."""
    return replace(two_point, manoeuvre=DRIVE_ON) if two_point.remaining_m is None else two_point


def _yaw_limit_reason(prediction: Prediction, limit: float) -> str:
    """Return the reason why no drive reaches the yaw limit, empty if one can."""
    alignment = prediction.alignment
    if not alignment.heading_separable:
        return ('not separable from the course over ground, the only heading; set '
                'alignment.heading_source')
    if alignment.heading_sigma >= limit:
        return ('limited by the heading uncertainty '
                f'({math.degrees(alignment.heading_sigma):.2g} deg)')
    return ''


def _with_expected_heading(leg: Leg, config: Config) -> Config:
    """Return config with the heading source, and its sigma, that the alignment will use."""
    def near_start(stamp_ns: Ints) -> Ints:
        return np.flatnonzero(stamp_ns <= leg.start_ns + ORIENTATION_NS)[-ORIENTATION_ROWS:]

    heading = leg.rows('heading')
    return with_heading(config, {
        'heading_topic': stated_variance(take(heading, near_start(heading.stamp_ns))),
        'imu_orientation': stated_variance(take(leg.imu, near_start(leg.imu.stamp_ns)))})


def _thin_rows(drive: PlannedDrive) -> PlannedDrive:
    """Return a drive with at most about DRIVE_ROWS rows; stops and starts are kept if few."""
    rest = np.abs(drive.speed) <= REST_SPEED
    changes = np.flatnonzero(np.diff(rest))      # last rows before a stop or a start
    if len(changes) > DRIVE_ROWS // 4:
        changes = changes[:0]
    count = min(len(rest), DRIVE_ROWS - 2 * len(changes))
    keep = np.unique(np.concatenate([
        np.linspace(0, len(rest) - 1, count).astype(int), changes, changes + 1]))
    return replace(drive, **{name: getattr(drive, name)[keep]
                             for name in ('t', 'speed', 'yaw', 'slope')})


def _with_final_rest(drive: PlannedDrive) -> PlannedDrive:
    """Return the drive with a standstill of PREDICTED_REST_S seconds at its end."""
    last = int(np.flatnonzero(np.abs(drive.speed) > REST_SPEED)[-1])      # row in motion
    rest_s = drive.duration - float(drive.t[last]) if last < len(drive.t) - 1 else 0.0
    return drive if rest_s >= PREDICTED_REST_S else drive.cut_at(
        drive.duration, PREDICTED_REST_S - rest_s)
