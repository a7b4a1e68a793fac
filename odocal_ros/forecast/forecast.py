# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecast of a leg: its sigmas if it ended here, remaining distances to the limits, as text."""

from dataclasses import dataclass, field, replace
import math

import numpy as np

from odocal_ros.calib.number_text import relative_unit
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.reasons import Reason

FARTHEST_LIMIT_M = 2e4    # judgement: longest remaining distance of a useful forecast
# definition
UNREACHABLE_TEXT = f'the limit is not reached within another {FARTHEST_LIMIT_M / 1000:.0f} km'
# judgement: standstill at a predicted end; it gives the level and the gyro bias
PREDICTED_REST_S = 10.0
SOURCE_SHARE = 0.01    # judgement: share of the variance; smaller sources are not listed
# estimates in ~/status, and the unit at the end of their keys
RUNNING_UNITS = {'scale_factor': '', 'yaw_mounting_angle': '_rad', 'pitch_mounting_angle': '_rad'}


class LegEnded(Exception):
    """The leg has ended: its forecast is not needed."""


@dataclass(frozen=True)
class ParameterForecast:
    """The forecast of one parameter."""

    sigma: float | None     # predicted, relative or rad; None: not determined so far
    limit: float            # required sigma
    remaining_m: float | None    # remaining distance to the limit; 0: reached, None: unreachable
    sources: tuple[tuple[str, float], ...] = ()     # (name, sigma) of the largest errors, in order
    limitation: str = ''    # reason why more driving does not reach the limit
    value_text: str = ''    # the value so far, as text, if it is determined before the end
    manoeuvre: str = ''     # required manoeuvres, besides distance

    def as_text(self, name: str, unit: str, factor: float, driven_m: float = 0.0) -> str:
        """
        Return the forecast as text.

        name : of the parameter.   unit, factor : of the printed sigmas, and from ``sigma`` to it.
        driven_m : path length since the forecast, m.
        """
        if unit == 'ppm':
            factor, unit = relative_unit(self.sigma or 0.0, self.limit)
        limit = three_digits(float(f'{self.limit * factor:.2g}'))
        limit_with_unit = f'{limit} {unit}'
        sigma = None if self.sigma is None else three_digits(self.sigma * factor)
        estimate = name if sigma is None else f'{name} {sigma} {unit}'
        if self.value_text and sigma is not None:
            estimate = f'{name} {self.value_text} ± {sigma} {unit}'
        if self.manoeuvre:
            return f'{estimate} so far (limit {limit})' if self.value_text else (
                f'{name} is not determined yet' + (f' ({sigma} {unit})' if sigma else ''))
        if self.remaining_m is None:
            return f'{estimate}: {self.limitation}'
        if self.remaining_m == 0.0:
            return f'OK: {estimate} (limit {limit})'
        remaining_m = self.remaining_m - driven_m
        action = (f'drive {_rounded_up(remaining_m)} m more' if remaining_m > 0 else 'drive on') \
            + f' to reach the limit of {limit_with_unit}'
        if sigma is None:
            return f'{name} is not determined yet; {action}'
        return f'{estimate} so far; {action}' if self.value_text else (
            f'{name} uncertainty so far: {sigma} {unit}; {action}')


@dataclass(frozen=True)
class WheelsForecast:
    """Relative sigmas of the worse wheel and of the track width so far; None: not determined."""

    left_right: float | None
    track_width: float | None


@dataclass(frozen=True)
class Forecast:
    """The forecast of a leg that ends at the current position."""

    scale: ParameterForecast
    yaw: ParameterForecast
    pitch: float | None = None                # rad, sigma
    wheels: WheelsForecast | None = None      # None with one counter, and before the first one
    methods: dict[str, MethodResult] = field(default_factory=dict)    # smoother, or planar
    estimates: dict[str, Estimate] = field(default_factory=dict)      # so far, as in a result
    until_ns: int = 0                         # stamp of the newest sample used
    distance_m: float = 0.0                   # path length of the leg at this stamp
    faults: tuple[Reason, ...] = ()           # for which the leg is rejected at any length

    def sigma(self, quantity: str) -> float | None:
        """Return the sigma of a quantity (scale, yaw, pitch, left_right, track_width)."""
        wheels = self.wheels or WheelsForecast(None, None)
        return {'scale': self.scale.sigma, 'yaw': self.yaw.sigma, 'pitch': self.pitch,
                'left_right': wheels.left_right, 'track_width': wheels.track_width}[quantity]

    def as_text(self, distance_m: float = 0.0) -> str:
        """Return limits and remaining distances as text; distance_m : of the leg by now, m."""
        driven_m = max(0.0, distance_m - self.distance_m)
        return '; '.join([self.scale.as_text('scale', 'ppm', 1e6, driven_m),
                          self.yaw.as_text('yaw', 'deg', math.degrees(1), driven_m)])

    @property
    def is_complete(self) -> bool:
        """Return True if more driving cannot reach any limit."""
        return not (self.scale.remaining_m or self.yaw.remaining_m or self.manoeuvres)

    @property
    def manoeuvres(self) -> list[str]:
        """Return the required manoeuvres, besides distance."""
        return list(dict.fromkeys(parameter.manoeuvre for parameter in (self.scale, self.yaw)
                                  if parameter.manoeuvre))

    def without_predictions(self) -> 'Forecast':
        """Return the running estimate only, for a leg that has ended."""
        scale, yaw = (ParameterForecast(None, parameter.limit, None)
                      for parameter in (self.scale, self.yaw))
        return Forecast(scale, yaw, estimates=self.estimates, until_ns=self.until_ns)

    def age_s(self, stamp_ns: int) -> float:
        """Return the time from the estimate to a stamp, s; NaN if the stamp is not after it."""
        age = (stamp_ns - self.until_ns) * 1e-9
        return age if age >= 0 else math.nan       # implausible stamps, or the IMU has stopped


def combine_sections(earlier: Forecast | None, newest: Forecast | None) -> Forecast | None:
    """Return the forecast of two sections of a leg, each quantity from the better one."""
    if earlier is None or newest is None:
        return newest or earlier
    sections = newest, earlier
    estimates = {name: min((section.estimates[name] for section in sections
                            if name in section.estimates), key=sigma_or_infinity)
                 for name in {**earlier.estimates, **newest.estimates}}
    pitch = min((section.pitch for section in sections if section.pitch is not None), default=None)
    return replace(newest, scale=_combine_parameter(earlier.scale, newest.scale),
                   yaw=_combine_parameter(earlier.yaw, newest.yaw), pitch=pitch,
                   estimates=estimates, wheels=newest.wheels or earlier.wheels)


def sigma_or_infinity(estimate: Estimate | None, relative: bool = False) -> float:
    """Return the sigma of an estimate, relative to its value or not; infinite without one."""
    if estimate is None or estimate.value is None:
        return math.inf
    sigma = estimate.relative_sigma if relative else estimate.sigma
    return math.inf if sigma is None else sigma


def _combine_parameter(earlier: ParameterForecast, newest: ParameterForecast) -> ParameterForecast:
    """Return the forecast with the smaller sigma; what remains to drive is that of the newest."""
    if earlier.sigma is None or (newest.sigma is not None and newest.sigma <= earlier.sigma):
        return newest
    if earlier.remaining_m == 0.0 and not earlier.manoeuvre:
        return earlier
    return replace(earlier, remaining_m=newest.remaining_m, limitation=newest.limitation,
                   manoeuvre=newest.manoeuvre)


def status_keys(forecast: Forecast | None, age_s: float = math.nan) -> dict[str, str | float]:
    """Return the keys of ``~/status`` on a forecast; age_s : of its newest sample."""
    if forecast is None:
        unknown = ParameterForecast(None, 0.0, None)
        forecast, age_s = Forecast(unknown, unknown), math.nan
    keys: dict[str, str | float] = {'estimate_age_s': age_s}
    methods = []
    for name, unit in RUNNING_UNITS.items():
        estimate = forecast.estimates.get(name, Estimate(None, None, ''))
        known = estimate.value is not None
        methods += [estimate.method] * known
        for suffix, value in (('', estimate.value), ('_sigma', estimate.sigma if known else None)):
            keys[f'estimate_{name}{suffix}{unit}'] = math.nan if value is None else value
    keys['estimate_method'] = ', '.join(dict.fromkeys(methods))
    for name, parameter, unit, factor in (('scale', forecast.scale, 'ppm', 1e6),
                                          ('yaw', forecast.yaw, 'deg', math.degrees(1))):
        sigma, metres = parameter.sigma, parameter.remaining_m
        keys |= {
            f'predicted_{name}_sigma_{unit}': '' if sigma is None else sigma * factor,
            f'metres_to_go_{name}': '' if metres is None else metres,
            f'largest_error_source_{name}': parameter.sources[0][0] if parameter.sources else '',
            f'predicted_{name}_sources_{unit}': ', '.join(
                f'{source} {three_digits(size * factor)}' for source, size in parameter.sources)}
    return keys


def _rounded_up(metres: float) -> int:
    """Return a distance, m, rounded up to two digits."""
    step: int = 10 ** max(0, math.floor(math.log10(max(metres, 1.0))) - 1)
    return math.ceil(metres / step) * step


def three_digits(value: float) -> str:
    """Return a number in three digits; large numbers have no exponent."""
    return f'{value:.0f}' if value >= 999.5 else f'{value:.3g}'


def main_sources(method: MethodResult, parameter: str) -> tuple[tuple[str, float], ...]:
    """Return (name, sigma) of the main error sources of a parameter, the largest first."""
    row = method.parameters.index(parameter)
    sizes = {source.name: float(np.linalg.norm(source.effects[row])) for source in method.sources}
    min_variance = SOURCE_SHARE * sum(size**2 for size in sizes.values())
    return tuple(sorted(((name, size) for name, size in sizes.items() if size**2 > min_variance),
                        key=lambda source: -source[1]))
