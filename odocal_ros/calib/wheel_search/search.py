# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Search left scale, right scale and heading as in patent CN104359492A.

An orthogonal array is followed by response surfaces; least squares check the result. Heading is
here the counter-clockwise rotation of the dead-reckoned track: the error of the configured heading
minus the yaw mounting angle. Positions cannot separate the two.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.calib.wheel_search.minimisation import least_squares, LeastSquares, refine, Refined
from odocal_ros.calib.wheel_search.parameter_sets import (
    design_for,
    NAMES,
    parameter_sets,
    Ranges,
    Space,
)
from odocal_ros.calib.wheel_search.planar import PlanarLeg, score, Scores
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason

HEADING_MEANS = ('counter-clockwise rotation of the track: error of the configured heading minus '
                 'yaw mounting angle, which positions cannot separate')
MAX_ROWS = 100      # judgement: of an array kept in calibration.json


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of the search; sets are left and right scale (m per unit), heading (rad)."""

    start: tuple[float, float]  # scales before, m per unit
    ranges: Ranges
    array_name: str
    sets: Floats                # of the array's rows
    scores: Scores              # of these sets
    # row of the array with the smallest mean distance to the fixes (robust: smallest loss); ties:
    # smallest maximum distance
    best: int
    ratio_is_fixed: bool        # True: fixes do not separate left and right: ratio as in ``start``
    refined: Refined            # by response surfaces
    direct: LeastSquares        # by least squares
    free: LeastSquares          # the same with left and right free
    refined_set: Floats
    direct_set: Floats
    before: Scores              # of the start values, one row
    after: Scores               # of the refined ones
    reasons: tuple[Reason, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the content for calibration.json, angles in deg."""
        refined, direct = self.refined, self.direct
        ranges = [{'parameter': name, 'half': _in_degrees(name, half),
                   'at_the_end': _in_degrees(name, last_half),
                   'unit': 'deg' if name == 'heading' else '1', 'why': source}
                  for name, half, last_half, source in zip(
                      NAMES, self.ranges.half_range, refined.half_range, self.ranges.sources,
                      strict=True)]
        shown = np.arange(len(self.sets))
        if len(shown) > MAX_ROWS:      # the best ones, in the order of the array
            shown = np.sort(np.argsort(self.scores.mean, kind='stable')[:MAX_ROWS])
        return {
            'ranges': ranges,
            'array': {'name': self.array_name, 'rows': len(self.sets),
                      'shown': [_set(self.sets[k]) | self.scores.row(k) for k in shown.tolist()]},
            'best_row': _set(self.sets[self.best]) | self.scores.row(self.best),
            'left_and_right_held_together': self.ratio_is_fixed,
            'heading_means': HEADING_MEANS,
            'response_surface': _set(self.refined_set) | {
                'iterations': refined.iterations, 'settled': refined.converged,
                'widened': refined.widened, 'on_edge': refined.on_edge} | {
                f'{name}_{place}': getattr(surface, name) for name in ('r_squared', 'lack_of_fit')
                for place, surface in (('first', refined.first), ('last', refined.last))},
            'least_squares': _set(self.direct_set) | {
                'iterations': direct.iterations, 'settled': direct.converged,
                'formal_sigma': _set(direct.sigma * [*self.start, 1.0])},
            'condition_number': _finite(self.free.condition),
            'correlation': [[float(c) for c in row] for row in self.free.correlation],
            'sigma_right_less_left': _finite(self.free.sigma_difference),
            'before': self.before.row(0), 'after': self.after.row(0)}


def _in_degrees(name: str, value: float) -> float:
    """Return a heading in deg, a relative scale unchanged."""
    return float(np.rad2deg(value) if name == 'heading' else value)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _set(parameters: Floats) -> dict[str, float]:
    left, right, heading = (float(p) for p in parameters)
    return {'scale_left': left, 'scale_right': right, 'heading_deg': float(np.rad2deg(heading))}


def search(leg: PlanarLeg, ranges: Ranges, robust: bool = False) -> SearchResult | None:
    """
    Search left scale, right scale and heading; None with fewer than four fixes.

    leg : tracks and fixes; its start values are the middle of the ranges.   robust : weight fixes
    by their sigma and limit the influence of outliers.
    """
    if len(leg.t) < 4:
        return None
    array_name, rows = design_for(ranges.levels)
    x = ranges.values(rows)
    sets = parameter_sets(leg, x)
    scores = score(leg, sets, robust)
    best = int(np.lexsort((scores.max, scores.loss if robust else scores.mean))[0])
    free = direct = least_squares(leg, x[best], Space(ratio_is_fixed=False), robust)
    # half ranges are 2 sigma: the ratio is fixed if the fixes do not reduce its sigma
    ratio_is_fixed = not free.sigma_difference <= difference_limit(ranges)
    space = Space(ratio_is_fixed)
    if ratio_is_fixed:
        direct = least_squares(leg, x[best], space, robust)
    refined = _refine(leg, x[best], ranges, space, robust)
    refined_set, direct_set = (parameter_sets(leg, fit.x)[0] for fit in (refined, direct))
    refined_set[2], direct_set[2] = wrap(refined_set[2]), wrap(direct_set[2])
    return SearchResult(
        (leg.scale_left, leg.scale_right), ranges, array_name, sets, scores, best,
        ratio_is_fixed, refined, direct, free, refined_set, direct_set,
        score(leg, leg.start, robust), score(leg, refined_set, robust),
        _reasons(ranges, refined, direct, free, ratio_is_fixed))


def difference_limit(ranges: Ranges) -> float:
    """Return the largest relative sigma of right minus left with which they are separate."""
    return float(np.hypot(*ranges.half_range[:2])) / 2


def _refine(leg: PlanarLeg, x: Floats, ranges: Ranges, space: Space, robust: bool) -> Refined:
    """Return the minimum of the mean square; if robust, from there that of Huber's mean."""
    # far from its minimum, Huber's mean is a cone, which a polynomial does not fit
    def criterion(robust: bool) -> Callable[..., Any]:
        return lambda x: score(leg, parameter_sets(leg, x), robust, course=False).loss

    by_squares = refine(criterion(False), x, ranges.step, ranges.half_range, space)
    if not robust:
        return by_squares
    by_huber = refine(criterion(True), by_squares.x, ranges.step / 10, by_squares.half_range,
                      space)
    return replace(by_huber, widened=by_squares.widened or by_huber.widened,
                   first=by_squares.first, iterations=by_squares.iterations + by_huber.iterations)


def _reasons(ranges: Ranges, refined: Refined, direct: LeastSquares, free: LeastSquares,
             ratio_is_fixed: bool) -> tuple[Reason, ...]:
    reasons = []
    if ratio_is_fixed:
        sigma = 100 * free.sigma_difference
        text = f'{sigma:.2g} %' if sigma < 100 else '100 % or more'
        reasons.append(Reason(
            Code.WHEELS_NOT_SEPARABLE, 'left and right scale cannot be separated: the sigma of '
            f'their difference is {text} (limit {100 * difference_limit(ranges):.2g} %; condition '
            f'number {free.condition:.2g}, correlation {free.correlation[0, 1]:+z.6f}). The '
            'search changed both together'))
    if refined.widened:
        changes = [f'{name} ± {_amount(name, before)} to ± {_amount(name, after)}'
                   for name, before, after in zip(
                       NAMES, ranges.half_range, refined.half_range, strict=True)
                   if after > before]
        reasons.append(Reason(Code.SEARCH_WIDENED, 'the minimum was on the edge of the search '
                              f'range, which was widened: {", ".join(changes)}'))
    if not refined.converged or refined.on_edge:
        text = 'ends on the edge of the widest range' if refined.on_edge else \
            f'has not converged after {refined.iterations} response surfaces'
        reasons.append(Reason(Code.SEARCH_NOT_SETTLED, f'the search {text}'))
    else:
        difference = np.abs(refined.x - direct.x)
        difference[2] = abs(wrap(difference[2]))
        share = float((difference / ranges.half_range).max())
        max_share = 1e-3    # of the range
        if share > max_share or not direct.converged:
            reasons.append(Reason(Code.SEARCH_NOT_SETTLED, 'response surface and least squares '
                                  f'differ by {100 * share:.2g} % of the range'))
    return tuple(reasons)


def _amount(name: str, value: float) -> str:
    return f'{np.rad2deg(value):.3g} deg' if name == 'heading' else f'{100 * value:.3g} %'
