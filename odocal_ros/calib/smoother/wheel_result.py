# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the wheels of a leg, or of several, say: factors, track width, and why there are none."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.calib.smoother.wheels import Wheel
from odocal_ros.calib.track_width import TRACK_WIDTH
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import INFORMED_SHARE, REMARK_SIGMAS, TYRE_SPREAD

SIDES = ('left', 'right')
FACTORS = tuple(f'scale_factor_{side}' for side in SIDES)


def wheel_details(wheels: Sequence[Wheel]) -> dict[str, Any]:
    """Return what calibration.json holds of the wheels of a leg, {} of one counter."""
    return {'wheels': {side: asdict(wheel) for side, wheel in zip(SIDES, wheels, strict=True)}} \
        if wheels else {}


def unknown_wheels(scale_unit: str) -> dict[str, Estimate]:
    """Return the estimates of two wheels of which nothing is known."""
    return dict.fromkeys(FACTORS, Estimate(None, None, scale_unit)) | {
        'track_width': Estimate(None, None, 'm')}


def wheel_estimates(wheels: Sequence[Wheel], scale: Estimate,
                    config: Config) -> tuple[dict[str, Estimate], list[Reason]]:
    """
    Return the estimates of two wheels and what is to be said of them, docs/method.md (W4), (W8).

    wheels : left and right, () where nothing is known of them.   scale : of their mean.
    """
    found = unknown_wheels(scale.unit)
    if scale.value is None or scale.sigma is None:
        return found, []
    limit = INFORMED_SHARE * (config.wheels.radius_range or TYRE_SPREAD)
    # one line, seen twice: right by left is off by twice what either is off from the mean
    sigma = 2 * wheels[0].ratio_sigma if wheels else np.inf
    if sigma > limit:
        known = f'has an uncertainty of {100 * sigma:.2g} %' if wheels else 'is not known'
        return found, [Reason(Code.WHEELS_NOT_SEPARABLE, 'the ratio of right to left wheel '
                              f'{known}; the limit is {100 * limit:.2g} %. The factors of the '
                              'wheels are not stated')]
    for name, wheel in zip(FACTORS, wheels, strict=True):
        value = scale.value * wheel.ratio
        relative = np.hypot(scale.sigma / scale.value, wheel.ratio_sigma)
        found[name] = Estimate(value, float(value * relative), scale.unit)
    width, why = _track_width(wheels, config.odometer.track_width)
    return found | {'track_width': width}, why


def _track_width(wheels: Sequence[Wheel], given: float) -> tuple[Estimate, list[Reason]]:
    left, right = wheels
    width, sigma = left.y - right.y, left.y_sigma + right.y_sigma     # one line, seen twice
    none = Estimate(None, None, 'm')
    if given and sigma >= INFORMED_SHARE * TRACK_WIDTH.taped_share * given:
        return none, []         # the tape knows it better
    if sigma < TRACK_WIDTH.least and width < TRACK_WIDTH.least:
        return none, [Reason(Code.TRACK_WIDTH_NOT_DETERMINED, 'the wheel difference does not '
                             f'match the gyro turns: the track width would be {width:.2g} m')]
    if sigma >= TRACK_WIDTH.determined_share * max(width, TRACK_WIDTH.least):
        return none, [Reason(Code.TRACK_WIDTH_NOT_DETERMINED, 'track width uncertainty is '
                             f'{sigma:.2g} m. Likely cause: too few turns')]
    if given and abs(width - given) > REMARK_SIGMAS * np.hypot(
            TRACK_WIDTH.taped_share * given, sigma):
        return Estimate(width, sigma, 'm'), [Reason(
            Code.TRACK_WIDTH_FAR_FROM_GIVEN, f'estimated track width is {width:.4f} +- '
            f'{sigma:.4f} m; odometer.track_width is {given:.4g} m')]
    return Estimate(width, sigma, 'm'), []


def joined(legs: Sequence[MethodResult]) -> tuple[Wheel, ...]:
    """
    Return the wheels of several legs, means by their variances: () where no leg knows them.

    Where legs differ by more than their sigmas allow, the sigma is as much larger.
    """
    each = [leg.details['wheels'] for leg in legs if leg.details.get('wheels')]
    return tuple(_mean([one[side] for one in each]) for side in SIDES) if each else ()


def _mean(wheels: Sequence[Mapping[str, Any]]) -> Wheel:
    mean = {}
    for name in ('ratio', 'y'):
        x, sigma = (np.array([w[key] for w in wheels]) for key in (name, f'{name}_sigma'))
        weight = 1 / sigma**2
        mean[name] = float(x @ weight / weight.sum())
        chi2 = float(((x - mean[name])**2 @ weight) / max(len(x) - 1, 1))
        mean[f'{name}_sigma'] = float(np.sqrt(max(chi2, 1.0) / weight.sum()))
    return Wheel(**mean, walk=tuple(wheels[-1]['walk']))
