# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecast from the running estimate of the smoother, or from the planar estimator."""

from collections.abc import Callable
from dataclasses import replace
import math

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.choice import choose, deciding_methods, PLANAR, REASON_ESTIMATES
from odocal_ros.calib.result import LegResult, MethodResult
from odocal_ros.data.leg import Leg
from odocal_ros.errors import BadData, OdocalError
from odocal_ros.estimator import RunningEstimate
from odocal_ros.forecast.forecast import (
    FARTHEST_LIMIT_M,
    Forecast,
    LegEnded,
    main_sources,
    ParameterForecast,
    UNREACHABLE_TEXT,
    WheelsForecast,
)
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.pipeline.calibrate import PROVISIONAL_CODES
from odocal_ros.pipeline.planar_run import planar_leg
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Code, rejecting, Verdict
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.settings.config import Config

ONLY_SMOOTHER = ('smoother',)
SCALE, YAW, PITCH = PARAMETERS
# physical: m/s^2 of an ordinary stop and start, and the minimum speed for it, m/s
STOP_ACCELERATION, STOP_SPEED = 1.5, 5.0
# physical: path length is proportional to sigma^-power. White errors of the fixes: the ends count,
# sigma ~ 1 / length; time-correlated ones: sections count, sigma ~ 1 / sqrt(length)
PATH_POWER, PATH_POWER_SLOW = 1.0, 2.0
MAX_STOPS = 50    # judgement: limit of a useful number of stops and starts
# codes that disappear with more driving
TEMPORARY_CODES = PROVISIONAL_CODES | {Code.ODOMETER_STILL}
DRIVE_ON = 'drive straights, and turn on the spot in both directions'


def update_running(leg: Leg, config: Config, smoother: SmootherSoFar | None,
                   is_needed: Callable[[], bool]) -> RunningEstimate | None:
    """Return the running estimate, None without; raise OdocalError if no other method is used."""
    if smoother is None or 'smoother' not in deciding_methods(config.method):
        return None
    try:
        return smoother.update(leg, config, is_needed)
    except OdocalError:
        if deciding_methods(config.method) == ONLY_SMOOTHER:
            raise
        return None


def has_all_values(running: RunningEstimate | None) -> bool:
    """Return True if scale, yaw and pitch of the result will come from the smoother."""
    return running is not None and running.method.verdict is not Verdict.REJECTED and all(
        running.method.estimates[name].value is not None for name in PARAMETERS)


def without_accelerometer_values(forecast: Forecast) -> Forecast:
    """Return a forecast without the values that need an accelerometer."""
    yaw = forecast.yaw
    if yaw.sigma is None and not yaw.limitation:
        yaw = replace(yaw, limitation='not determined without an accelerometer or an external '
                                      'heading')
    return replace(forecast, yaw=yaw, pitch=None)


def add_running_estimate(forecast: Forecast, running: RunningEstimate, config: Config) -> Forecast:
    """Return a forecast with the running estimate for the values that it will give."""
    method = running.method
    faults = tuple(reason for reason in rejecting(method.reasons)
                   if reason.code not in REASON_ESTIMATES)
    if faults:      # its values are useless then
        return replace(forecast, faults=faults)
    if method.verdict is not Verdict.REJECTED:
        forecast = replace(forecast, methods=forecast.methods | {'smoother': method})
    estimates, _ = choose(forecast.methods, config.method)
    by_smoother = {name for name, estimate in estimates.items()
                   if estimate.value is not None and estimate.method == 'smoother'}
    scale, yaw, pitch = forecast.scale, forecast.yaw, forecast.pitch
    if SCALE in by_smoother or scale.sigma is None:
        scale = _forecast_scale(running, scale.limit)
    _, has_yaw, has_pitch = np.isfinite(running.sigmas)      # False without an accelerometer
    if has_yaw and (YAW in by_smoother or yaw.sigma is None):
        yaw = _forecast_yaw(running, yaw.limit)
    if has_pitch and (PITCH in by_smoother or pitch is None):
        pitch = float(running.sigmas[2])
    return replace(forecast, scale=scale, yaw=yaw, pitch=pitch, wheels=forecast_wheels(method))


def forecast_wheels(method: MethodResult) -> WheelsForecast | None:
    """Return the running estimate of two wheels, None for one counter."""
    if 'track_width' not in method.estimates:
        return None
    left, right, width = (method.estimates[name].relative_sigma for name in (
        'scale_factor_left', 'scale_factor_right', 'track_width'))
    return WheelsForecast(None if left is None or right is None else max(left, right), width)


def _forecast_scale(running: RunningEstimate, limit: float) -> ParameterForecast:
    """Return the forecast of the scale, whose sigma falls with the path length."""
    scale = running.method.estimates[SCALE]
    sigma = float(running.sigmas[0])
    slow = _slow_share(running)
    power = PATH_POWER_SLOW * slow + PATH_POWER * (1 - slow)
    metres = _remaining_distance(running.distance, sigma, limit, power)
    value = '' if scale.value is None or scale.sigma is None else format_value(
        scale.value, scale.sigma)
    if value and scale.unit != '1':
        value += f' {scale.unit}'
    return ParameterForecast(sigma, limit, metres, main_sources(running.method, SCALE),
                             UNREACHABLE_TEXT, value)


def _slow_share(running: RunningEstimate) -> float:
    """Return the share of slow errors in the contribution of fixes to the scale's variance."""
    variances = {source.name: float((source.effects[0]**2).sum())
                 for source in running.method.sources
                 if source.name in ('fixes', 'slow_fix_errors')}
    total = sum(variances.values())
    return variances.get('slow_fix_errors', 0.0) / total if total else 0.0


def _forecast_yaw(running: RunningEstimate, limit: float) -> ParameterForecast:
    """Return the forecast of the yaw: its information is proportional to running.agility."""
    yaw = running.method.estimates[YAW]
    sigma = float(running.sigmas[1])
    manoeuvre = ''
    if sigma > limit:
        stop_agility = 2 * STOP_ACCELERATION * max(running.speed, STOP_SPEED)
        ratio = sigma / limit if limit else math.inf
        stops = max(running.agility, stop_agility / 2) * (ratio**2 - 1) / stop_agility
        times = 'often' if stops > MAX_STOPS else f'{math.ceil(stops)} time{"s" * (stops > 1)}'
        manoeuvre = f'for the yaw: stop and start {times}, or make as many turns'
    value = '' if yaw.value is None or yaw.sigma is None else format_value(
        math.degrees(yaw.value), math.degrees(yaw.sigma))
    metres = _remaining_distance(running.distance, sigma, limit, 2.0)
    return ParameterForecast(sigma, limit, metres, main_sources(running.method, YAW), '',
                             value, manoeuvre)


def _remaining_distance(distance: float, sigma: float, limit: float,
                        power: float) -> float | None:
    """Return the further distance that brings a sigma to its limit, driven as so far, m."""
    metres = distance * (max(sigma / limit, 1.0)**power - 1) if limit else math.inf
    return metres if metres <= FARTHEST_LIMIT_M else None


def format_value(value: float, sigma: float) -> str:
    """Return a value to a tenth of its sigma, with at most eight digits."""
    size = max(abs(value), sigma)
    digits = math.floor(math.log10(size)) - math.floor(math.log10(sigma)) + 2
    return f'{value:.{min(max(digits, 1), 8)}g}'


def planar_forecast(leg: Leg, config: Config, is_needed: Callable[[], bool]) -> Forecast:
    """
    Return the forecast of a leg by the planar estimator.

    Raises LegEnded: ``is_needed`` returns False during the fit; BadData: no fit is possible.
    """
    def check_needed(_: Stage | None = None) -> None:
        if not is_needed():
            raise LegEnded
    result = planar_leg(leg, settings_by_frame(leg.fix, config), (), check_needed)
    check_needed()
    method = result.methods[PLANAR]
    if result.track_n is None:
        raise BadData(method.reasons[0].text)
    faults = tuple(reason for reason in rejecting((*result.reasons, *method.reasons))
                   if reason.code not in {*REASON_ESTIMATES, *TEMPORARY_CODES})
    estimates, _ = choose(result.methods, config.method)
    return Forecast(
        _planar_scale(result, config.verdict.max_scale_sigma),
        ParameterForecast(None, config.verdict.max_yaw_sigma, None,
                          limitation='not estimated on this robot'),
        wheels=forecast_wheels(method), methods={PLANAR: method}, estimates=estimates,
        until_ns=leg.stop_ns, faults=faults)


def _planar_scale(result: LegResult, limit: float) -> ParameterForecast:
    """Return the forecast of the scale, whose sigma falls with the root of the distance."""
    scale = result.methods[PLANAR].estimates['scale_factor']
    sigma = scale.relative_sigma
    if sigma is None or scale.value is None or scale.sigma is None:
        return ParameterForecast(None, limit, None, manoeuvre=DRIVE_ON)
    return ParameterForecast(
        sigma, limit, _remaining_distance(result.distance, sigma, limit, 2.0),
        limitation=UNREACHABLE_TEXT, value_text=format_value(scale.value, scale.sigma))
