# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimates of single wheels of one or several legs: scale factors, track width, reasons."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from odocal_ros.calib.result import Estimate, MethodResult, WHEEL_PREFIX
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.axles import pair_wheels
from odocal_ros.settings import levels
from odocal_ros.settings.config import Config, SIDES
from odocal_ros.settings.levels import TRACK_WIDTH

MIN_COMPARED_WHEELS = 3     # wheels, definition: with fewer, it is unknown which one differs
# relative, judgement: difference of new tyres of one size; a third less pressure makes half of it
MAX_WHEEL_DIFFERENCE = 0.01


@dataclass(frozen=True, eq=False)
class Wheel:
    """A wheel relative to the mean of all wheels."""

    ratio: float             # scale factor over that of the mean reading
    ratio_sigma: float       # relative
    y: float                 # m, to the left
    y_sigma: float           # m
    # m/sqrt(s), random walk at constant speed, at acceleration and braking, in turns
    walk: tuple[float, ...]
    x: float | None = None   # m, ahead, of a steered wheel; None: it does not steer
    x_sigma: float | None = None


def wheel_details(wheels: Mapping[str, Wheel]) -> dict[str, Any]:
    """Return the entry of the wheels in calibration.json, {} for one counter."""
    entries = {name: {key: value for key, value in asdict(wheel).items() if value is not None}
               for name, wheel in wheels.items()}
    return {'wheels': entries} if wheels else {}


def unknown_wheels(names: Sequence[str], scale_unit: str) -> dict[str, Estimate]:
    """Return the estimates of wheels without values, {} for one counter."""
    return {WHEEL_PREFIX + name: Estimate(None, None, scale_unit) for name in names} | {
        width: Estimate(None, None, 'm') for width in _widths(names)}


def wheel_estimates(names: Sequence[str], wheels: Mapping[str, Wheel], scale: Estimate,
                    config: Config) -> tuple[dict[str, Estimate], list[Reason]]:
    """
    Return the estimates of several wheels and the reasons, docs/method.md (W4), (W8).

    names : of the wheels.   wheels : by name, empty if unknown.   scale : of their mean.
    """
    estimates = unknown_wheels(names, scale.unit)
    if scale.value is None or scale.sigma is None:
        return estimates, []
    limit = levels.INFORMED_SHARE * (config.wheels.radius_range or levels.TYRE_SPREAD)
    # errors of left and right are opposite: that of right over left is twice that of either
    sigma = 2 * max((wheel.ratio_sigma for wheel in wheels.values()), default=np.inf)
    if sigma > limit:
        accuracy = f'has an uncertainty of {100 * sigma:.2g} %' if wheels else 'is not known'
        pair = 'right to left wheel' if tuple(names) == SIDES else 'the wheels'
        return estimates, [Reason(
            Code.WHEELS_NOT_SEPARABLE, f'the ratio of {pair} {accuracy}; the limit is '
            f'{100 * limit:.2g} %. The factors of the wheels are not stated')]
    for name, wheel in wheels.items():
        value = scale.value * wheel.ratio
        relative = np.hypot(scale.sigma / scale.value, wheel.ratio_sigma)
        estimates[WHEEL_PREFIX + name] = Estimate(value, float(value * relative), scale.unit)
    reasons = _different_wheel_reasons(wheels)
    for width, (left, right) in _widths(names).items():
        estimates[width], width_reasons = _track_width(wheels[left], wheels[right],
                                                       config.odometer.track_width)
        reasons += width_reasons
        if (left, right) != SIDES and estimates[width].value is not None:
            estimates |= _positions({name: wheels[name] for name in (left, right)})
    return estimates, reasons


def _widths(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the names of the track widths, and the left and the right wheel of each."""
    axles = [axle for axle in pair_wheels(names) if len(axle) == len(SIDES)]
    return {'_'.join(('track_width', *(axle if axle != SIDES else ()))): axle for axle in axles}


def _positions(axle: Mapping[str, Wheel]) -> dict[str, Estimate]:
    """Return the positions of the wheels of an axle, m to the left and ahead of the mean."""
    estimates = {f'lateral_position_{name}': Estimate(wheel.y, wheel.y_sigma, 'm')
                 for name, wheel in axle.items()}
    return estimates | {f'forward_position_{name}': Estimate(wheel.x, wheel.x_sigma, 'm')
                        for name, wheel in axle.items() if wheel.x is not None}


def _different_wheel_reasons(wheels: Mapping[str, Wheel]) -> list[Reason]:
    """Return the reason for a single wheel whose factor differs from all others."""
    if len(wheels) < MIN_COMPARED_WHEELS:
        return []
    reasons = []
    for name, wheel in wheels.items():
        others = float(np.median([w.ratio for other, w in wheels.items() if other != name]))
        difference = wheel.ratio / others - 1
        limit = max(MAX_WHEEL_DIFFERENCE, levels.FAULT_SIGMAS * wheel.ratio_sigma)
        if abs(difference) > limit:
            reasons.append(Reason(
                Code.WHEEL_DEPARTS, f'the factor of wheel {name} is {100 * abs(difference):.2f} % '
                f'{"larger" if difference > 0 else "smaller"} than that of the others (limit '
                f'{100 * limit:.2g} %). Likely cause: tyre pressure, another tyre, or '
                'continuous slip'))
    return reasons if len(reasons) == 1 else []     # of several, it is unknown which one differs


def _track_width(left: Wheel, right: Wheel, configured: float) -> tuple[Estimate, list[Reason]]:
    """Return the track width and its reasons, (W8); configured : m, 0: unknown."""
    width, sigma = left.y - right.y, left.y_sigma + right.y_sigma
    unknown = Estimate(None, None, 'm')
    if configured and sigma >= levels.INFORMED_SHARE * TRACK_WIDTH.tape_share * configured:
        return unknown, []         # the configured width is more accurate
    if sigma < TRACK_WIDTH.minimum and width < TRACK_WIDTH.minimum:
        return unknown, [Reason(Code.TRACK_WIDTH_NOT_DETERMINED, 'the wheel difference does not '
                             f'match the gyro turns: the track width would be {width:.2g} m; '
                             f'the lower limit is {TRACK_WIDTH.minimum:g} m',
                             'Check that odometer.left and odometer.right are the wheels of one '
                             'axle, or set odometer.track_width.')]
    limit = TRACK_WIDTH.max_sigma_share * max(width, TRACK_WIDTH.minimum)
    if sigma >= limit:
        return unknown, [Reason(Code.TRACK_WIDTH_NOT_DETERMINED, 'track width uncertainty is '
                             f'{sigma:.2g} m; the limit is {limit:.2g} m. Likely cause: too few '
                             'turns')]
    limit = levels.REMARK_SIGMAS * float(np.hypot(TRACK_WIDTH.tape_share * configured, sigma))
    if configured and abs(width - configured) > limit:
        return Estimate(width, sigma, 'm'), [Reason(
            Code.TRACK_WIDTH_FAR_FROM_GIVEN, f'estimated track width is {width:.3f} ± '
            f'{sigma:.2g} m; odometer.track_width is {configured:.4g} m; the limit of the '
            f'difference is {limit:.2g} m')]
    return Estimate(width, sigma, 'm'), []


def combine_wheels(legs: Sequence[MethodResult]) -> dict[str, Wheel]:
    """Return the wheels of several legs: means, with sigmas from their scatter; {} without any."""
    by_name: dict[str, list[Mapping[str, Any]]] = {}
    for leg in legs:
        for name, wheel in leg.details.get('wheels', {}).items():
            by_name.setdefault(name, []).append(wheel)
    return {name: _mean(wheels) for name, wheels in by_name.items()}


def _mean(wheels: Sequence[Mapping[str, Any]]) -> Wheel:
    """Return the mean of entries of calibration.json of one wheel, with the last walk."""
    mean = {}
    for name in ('ratio', 'y', 'x'):
        if any(name not in wheel for wheel in wheels):
            continue
        x, sigma = (np.array([w[key] for w in wheels]) for key in (name, f'{name}_sigma'))
        weight = 1 / sigma**2
        mean[name] = float(x @ weight / weight.sum())
        variance_factor = float(((x - mean[name])**2 @ weight) / max(len(x) - 1, 1))
        mean[f'{name}_sigma'] = float(np.sqrt(max(variance_factor, 1.0) / weight.sum()))
    return Wheel(**mean, walk=tuple(wheels[-1]['walk']))
