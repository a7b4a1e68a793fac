# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The embodiment of CN104359492A: radii +-0.03 m in seven levels, heading +-1 deg in nine levels.

The patent lists seven combinations, selected by an orthogonal array, and states as best one that
is not among them. No orthogonal array for 7 x 7 x 9 levels is smaller than all 441 combinations.
The table compares a nearly balanced array of 81 with all combinations, the refined optimum and
least squares. Errors are added: true radius = nominal radius + error, and the track is rotated
counter-clockwise by the heading error.
"""

from dataclasses import dataclass
from itertools import combinations
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheel_search import minimisation
from odocal_ros.calib.wheel_search.parameter_sets import (
    bose_array,
    full_factorial,
    next_prime_power,
    parameter_sets,
    Space,
)
from odocal_ros.calib.wheel_search.planar import PlanarLeg, score
from odocal_ros.data.arrays import Floats, Ints

LEVELS = (7, 7, 9)    # definition: of the patent's embodiment
RADIUS_STEP = 0.01      # m, definition: of the patent's embodiment
# definition: left radius, right radius, m; heading, deg: as printed
PRINTED = ((-0.03, -0.03, 1.0), (0.0, 0.0, 0.25), (0.02, 0.02, -1.0), (0.0, -0.03, 0.25),
           (0.03, -0.03, -1.0), (0.03, 0.0, 0.25), (-0.03, 0.03, -1.0))
# definition: the combination printed as best, with distances of 21.76 m at most and 13.24 m in the
# mean
PRINTED_BEST = (-0.01, 0.01, 0.25)
NOMINAL_RADIUS = 0.3            # m, judgement: the patent states none


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    left: float               # m, error of the radius
    right: float
    heading_deg: float        # error
    criteria: dict[str, float | None]      # distances between track and fixes, by name, m


@dataclass(frozen=True, eq=False)
class Embodiment:
    """The table, and the results from which it is computed."""

    rows: tuple[Row, ...]
    imbalance: float             # of the array of 81, see ``imbalance``
    orthogonal_rows: int         # fewest rows of an orthogonal array
    response_surface: minimisation.SurfaceMinimum    # optimum within the range
    least_squares: minimisation.SquaresMinimum       # optimum without a range
    radius: float                # m, nominal, of both wheels
    mean_distance: NDArray[np.float64]    # (7, 7) m by left and right radius, of the best heading

    @property
    def sigma_radius(self) -> float:
        """Return the formal sigma of right minus left radius by positions, m."""
        return self.least_squares.sigma_difference * self.radius

    def as_dict(self) -> dict[str, Any]:
        """Return the output of ``odocal patent --json``."""
        surface, squares = self.response_surface, self.least_squares
        return {'radius': self.radius, 'rows': [vars(row) for row in self.rows],
                'imbalance': self.imbalance, 'orthogonal_rows': self.orthogonal_rows,
                'response_surface': {'iterations': surface.iterations,
                                     'settled': surface.converged, 'on_edge': surface.on_edge},
                'least_squares': {'condition_number': float(squares.condition),
                                  'correlation': float(squares.correlation[0, 1]),
                                  'sigma_right_less_left_m': float(self.sigma_radius)},
                'separable': self.separable}

    @property
    def separable(self) -> bool:
        """Return True if the fixes determine right minus left better than the range does."""
        return bool(self.sigma_radius <= np.sqrt(2) * 3 * RADIUS_STEP / 2)


def imbalance(rows: Ints, levels: tuple[int, ...]) -> float:
    """Return the largest deviation from equal counts over all pairs of levels."""
    largest = 0.0
    for a, b in combinations(range(len(levels)), 2):      # columns
        pairs = levels[a] * levels[b]
        counts = np.bincount(rows[:, a] * levels[b] + rows[:, b], minlength=pairs)
        largest = max(largest, float(np.abs(counts - len(rows) / pairs).max()))
    return largest


def min_rows(levels: tuple[int, ...]) -> int:
    """Return the smallest number of rows of an orthogonal array; others are multiples."""
    return math.lcm(*(a * b for a, b in combinations(levels, 2))) if len(levels) > 1 \
        else int(levels[0])


def nearly_balanced(levels: tuple[int, ...]) -> Ints:
    """
    Return a small array for different numbers of levels, (81, 3) for 7, 7 and 9, by dummy levels.

    In an orthogonal array of the next prime power, columns with fewer levels use some of them
    twice, evenly around the middle. Each pair of levels still occurs.
    """
    q = next_prime_power(max(*levels, len(levels) - 1))
    rows = bose_array(q, len(levels))
    for column, n in enumerate(levels):
        fold = np.rint((np.arange(q) + 0.5) * n / q - 0.5).astype(np.int64)
        rows[:, column] = np.clip(fold, 0, n - 1)[rows[:, column]]
    return rows


def embodiment(leg: PlanarLeg, radius: float = NOMINAL_RADIUS,
               truth: tuple[float, float, float] | None = None) -> Embodiment:
    """
    Run the embodiment on a leg.

    leg : its start values belong to wheels of the nominal radius.   radius : nominal radius of
    both wheels, m.   truth : (left, right, heading) true errors, m and deg, for one more line.
    """
    heading_step = np.deg2rad(0.25)
    # x: errors of left and right radius, relative to the nominal one, and of the heading, rad
    half_range = np.array([3 * RADIUS_STEP / radius, 3 * RADIUS_STEP / radius, 4 * heading_step])
    array = nearly_balanced(LEVELS)     # 81 rows
    array_x, all_x = (_errors_of(rows, half_range) for rows in (array, full_factorial(LEVELS)))
    (best_x, _), (best_of_all_x, mean_distances) = (_best(leg, x) for x in (array_x, all_x))
    step = 2 * half_range / (np.array(LEVELS) - 1)
    spaces = Space(ratio_is_fixed=False), Space(ratio_is_fixed=True)
    surface, surface_together = (
        minimisation.refine(lambda x: score(leg, parameter_sets(leg, x), course=False).loss,
                            best_x, step, half_range, space, widen=False) for space in spaces)
    squares, squares_together = (
        minimisation.least_squares(leg, best_x, space) for space in spaces)

    def row(name: str, x: Floats) -> Row:
        criteria = score(leg, parameter_sets(leg, x)).row(0)
        left, right = (float(r) for r in x[:2] * radius)
        return Row(name, left, right, float(np.rad2deg(x[2])), criteria)

    def row_of(name: str, errors: tuple[float, float, float]) -> Row:
        left, right, heading_deg = errors
        return row(name, np.array([left / radius, right / radius, np.deg2rad(heading_deg)]))

    rows = [row_of('start values', (0.0, 0.0, 0.0))]
    rows += [row_of(f'printed {k}', errors) for k, errors in enumerate(PRINTED, 1)]
    rows += [row_of('printed as best', PRINTED_BEST), row(f'best of {len(array)}', best_x),
             row(f'best of all {len(all_x)}', best_of_all_x),
             row('response surface', surface.x), row('  wheels together', surface_together.x),
             row('least squares', squares.x), row('  wheels together', squares_together.x)]
    rows += [] if truth is None else [row_of('truth', truth)]
    return Embodiment(tuple(rows), imbalance(array, LEVELS), min_rows(LEVELS), surface, squares,
                      radius, mean_distances.reshape(LEVELS).min(axis=2))


def _errors_of(level_numbers: Ints, half_range: Floats) -> Floats:
    """Return the errors x of level numbers, (n, 3) each; levels are even over the range."""
    x: Floats = (2 * level_numbers / (np.array(LEVELS) - 1) - 1) * half_range
    return x


def _best(leg: PlanarLeg, x: Floats) -> tuple[Floats, Floats]:
    """Return the row with the least mean distance, ties by the largest; and all mean distances."""
    scores = score(leg, parameter_sets(leg, x), course=False)
    return x[np.lexsort((scores.max, scores.mean))[0]], scores.mean
