# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Search left scale, right scale and heading as in patent CN104359492A.

The best row of an orthogonal array is refined by response surfaces; least squares check the
result. Heading is here the counter-clockwise rotation of the dead-reckoned track: the error of the
configured heading minus the yaw mounting angle. Positions cannot separate the two.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.calib.wheel_search import minimisation
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

    start: tuple[float, float]  # start values of the scales, m per unit
    ranges: Ranges
    array_name: str
    sets: Floats                # (n, 3) of the array's rows
    scores: Scores              # of these sets
    # row of the array with the smallest mean distance to the fixes (robust: smallest loss); ties:
    # smallest maximum distance
    best: int
    ratio_is_fixed: bool        # True: fixes do not separate left and right: ratio as in ``start``
    surface_minimum: minimisation.SurfaceMinimum
    squares_minimum: minimisation.SquaresMinimum    # by least squares
    free_minimum: minimisation.SquaresMinimum       # by least squares, ratio never fixed
    surface_set: Floats         # (3,) at ``surface_minimum``: the result of the search
    squares_set: Floats         # (3,) at ``squares_minimum``
    start_scores: Scores        # of the start values, one row
    surface_scores: Scores      # of ``surface_set``, one row
    reasons: tuple[Reason, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the content for calibration.json, angles in deg."""
        surface, squares, free = self.surface_minimum, self.squares_minimum, self.free_minimum
        ranges = [{'parameter': name, 'half': _in_degrees(name, half),
                   'at_the_end': _in_degrees(name, last_half),
                   'unit': 'deg' if name == 'heading' else '1', 'why': source}
                  for name, half, last_half, source in zip(
                      NAMES, self.ranges.half_range, surface.half_range, self.ranges.sources,
                      strict=True)]
        row_numbers = np.arange(len(self.sets))
        if len(row_numbers) > MAX_ROWS:      # the best ones, in the order of the array
            row_numbers = np.sort(np.argsort(self.scores.mean, kind='stable')[:MAX_ROWS])
        return {
            'ranges': ranges,
            'array': {'name': self.array_name, 'rows': len(self.sets),
                      'shown': [_entry(self.sets[k]) | self.scores.row(k)
                                for k in row_numbers.tolist()]},
            'best_row': _entry(self.sets[self.best]) | self.scores.row(self.best),
            'left_and_right_held_together': self.ratio_is_fixed,
            'heading_means': HEADING_MEANS,
            'response_surface': _entry(self.surface_set) | {
                'iterations': surface.iterations, 'settled': surface.converged,
                'widened': surface.widened, 'on_edge': surface.on_edge} | {
                f'{name}_{place}': getattr(polynomial, name)
                for name in ('r_squared', 'lack_of_fit')
                for place, polynomial in (('first', surface.first), ('last', surface.last))},
            'least_squares': _entry(self.squares_set) | {
                'iterations': squares.iterations, 'settled': squares.converged,
                'formal_sigma': _entry(squares.sigma * [*self.start, 1.0])},
            'condition_number': _finite(free.condition),
            'correlation': [[float(c) for c in row] for row in free.correlation],
            'sigma_right_less_left': _finite(free.sigma_difference),
            'before': self.start_scores.row(0), 'after': self.surface_scores.row(0)}


def _in_degrees(name: str, value: float) -> float:
    """Return a heading in deg, a relative scale unchanged."""
    return float(np.rad2deg(value) if name == 'heading' else value)


def _finite(value: float) -> float | None:
    """Return a number for JSON, None if it is infinite or NaN."""
    return float(value) if np.isfinite(value) else None


def _entry(parameter_set: Floats) -> dict[str, float]:
    left, right, heading = (float(p) for p in parameter_set)
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
    free = squares = minimisation.least_squares(leg, x[best], Space(ratio_is_fixed=False), robust)
    # half ranges are 2 sigma: the ratio is fixed if the fixes do not reduce its sigma
    ratio_is_fixed = not free.sigma_difference <= difference_limit(ranges)
    space = Space(ratio_is_fixed)
    if ratio_is_fixed:
        squares = minimisation.least_squares(leg, x[best], space, robust)
    surface = _refine(leg, x[best], ranges, space, robust)
    surface_set, squares_set = (parameter_sets(leg, fit.x)[0] for fit in (surface, squares))
    surface_set[2], squares_set[2] = wrap(surface_set[2]), wrap(squares_set[2])
    reasons = [*([_not_separable(ranges, free)] if ratio_is_fixed else []),
               *_convergence_reasons(ranges, surface, squares)]
    return SearchResult(
        (leg.scale_left, leg.scale_right), ranges, array_name, sets, scores, best,
        ratio_is_fixed, surface, squares, free, surface_set, squares_set,
        score(leg, leg.start, robust), score(leg, surface_set, robust), tuple(reasons))


def difference_limit(ranges: Ranges) -> float:
    """Return the largest relative sigma of right minus left with which they are separable."""
    return float(np.hypot(*ranges.half_range[:2])) / 2


def _refine(leg: PlanarLeg, x: Floats, ranges: Ranges, space: Space,
            robust: bool) -> minimisation.SurfaceMinimum:
    """Return the minimum of the mean square; if robust, from there that of Huber's mean."""
    # far from its minimum, Huber's mean is a cone, which a polynomial does not fit
    def criterion(robust: bool) -> Callable[..., Any]:
        return lambda x: score(leg, parameter_sets(leg, x), robust, course=False).loss

    by_squares = minimisation.refine(criterion(False), x, ranges.step, ranges.half_range, space)
    if not robust:
        return by_squares
    by_huber = minimisation.refine(criterion(True), by_squares.x, ranges.step / 10,
                                   by_squares.half_range, space)
    return replace(by_huber, widened=by_squares.widened or by_huber.widened,
                   first=by_squares.first, iterations=by_squares.iterations + by_huber.iterations)


def _not_separable(ranges: Ranges, free: minimisation.SquaresMinimum) -> Reason:
    """Return the reason that left and right scale cannot be separated."""
    sigma = 100 * free.sigma_difference
    sigma_text = f'{sigma:.2g} %' if sigma < 100 else '100 % or more'
    return Reason(
        Code.WHEELS_NOT_SEPARABLE, 'left and right scale cannot be separated: the sigma of '
        f'their difference is {sigma_text} (limit {100 * difference_limit(ranges):.2g} %; '
        f'condition number {free.condition:.2g}, correlation {free.correlation[0, 1]:+z.6f}). The '
        'search changed both together')


def _convergence_reasons(ranges: Ranges, surface: minimisation.SurfaceMinimum,
                         squares: minimisation.SquaresMinimum) -> list[Reason]:
    """Return the reasons if the search range was widened, or the search has not converged."""
    reasons = []
    if surface.widened:
        changes = [f'{name} ± {_amount(name, before)} to ± {_amount(name, after)}'
                   for name, before, after in zip(
                       NAMES, ranges.half_range, surface.half_range, strict=True)
                   if after > before]
        reasons.append(Reason(Code.SEARCH_WIDENED, 'the minimum was on the edge of the search '
                              f'range, which was widened: {", ".join(changes)}'))
    if not surface.converged or surface.on_edge:
        text = 'ends on the edge of the widest range' if surface.on_edge else \
            f'has not converged after {surface.iterations} response surfaces'
        return [*reasons, Reason(Code.SEARCH_NOT_SETTLED, f'the search {text}')]
    difference = np.abs(surface.x - squares.x)
    difference[2] = abs(wrap(difference[2]))
    share = float((difference / ranges.half_range).max())
    max_share = 1e-3    # of the range
    if share > max_share or not squares.converged:
        text = 'least squares have not converged' if not squares.converged else (
            f'response surface and least squares differ by {100 * share:.2g} % of the search '
            f'range; the limit is {100 * max_share:g} %')
        reasons.append(Reason(Code.SEARCH_NOT_SETTLED, text))
    return reasons


def _amount(name: str, value: float) -> str:
    return f'{np.rad2deg(value):.3g} deg' if name == 'heading' else f'{100 * value:.3g} %'
