# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
One step of the noise levels towards the maximum of the restricted likelihood, (S26) to (S29).

``update_levels`` returns the new levels from the residuals of a pass (docs/method.md).

The errors of a receiver with a filter grow in proportion to time, those of the model (a
Gauss-Markov process) with its root: differences of adjacent fixes then underestimate them. The
growth over longer spans is therefore compared with that of the model, (S17a).
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.equations import Weighted
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.factors.pseudo_observations import PriorRows, SIZE_SPREADS, SIZES
from odocal_ros.estimator.factors.slow_error import TIME_SPREAD
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.time_series import NORMAL_MEDIAN

# spans in a leg, minimum: statistical, with two axes, the sigma of their variance is then 35 %
MIN_SPANS = 8
# axes (east, north, up) of the levels of the correlated fix error
SLOW_COLUMNS = {'slow': slice(0, 2), 'slow_up': slice(2, 3)}     # of ENU


@dataclass(frozen=True)
class OverRelaxation:
    """
    Exponents h of (S27): the fixed-point iteration converges slowly for small noises.

    ``slower`` is undone if the next step is in the same direction again, because a small exponent
    converges slowly (recovery by ``faster``: 1.04 times the iterations).
    """

    first: float = 1.6          # from 2 on a single level oscillates
    faster: float = 1.25        # factor after a step in the same direction
    slower: float = 0.5         # factor after a step in the opposite direction
    largest: float = 3.0


RELAXATION = OverRelaxation()
# pseudo-observations of the prior of an IMU level. Judgement: equivalent to a few seconds
PSEUDO_OBSERVATIONS = {'gyro': 5.0, 'accel': 5.0, 'gyro_walk': 3.0, 'accel_walk': 3.0}
# levels with a slip factor
SLIP_LEVELS = ('along', 'along_hard', 'side', 'side_turn', 'up')


def prior_information(levels: Levels) -> dict[str, float]:
    """Return the prior information on the logarithm of each level, by name: N of (S27b)."""
    return {name: SIZE_SPREADS[name]**-2 if name in SIZES
            else TIME_SPREAD**-2 if name == 'correlation_time'
            else PSEUDO_OBSERVATIONS.get(name, 1.0) / 2 for name in levels.values}


def update_levels(weighted: Weighted, marginals: JointMarginals, levels: Levels, problem: Problem,
                  pace: dict[str, tuple[float, float]], fitted: bool = True) -> Levels:
    """
    Return the levels after one step of (S27); sizes of imperfections by (S29).

    pace : exponent and last step of each level, updated in place.   fitted : residuals are noise;
    otherwise they depend on the initial state, and the sizes are kept.
    """
    new, components = {}, weighted.components(marginals)
    if 'slow' in components and 'fix' in components:
        for name, factor in long_span_factors(weighted[Fixes], levels, components).items():
            components[name] = factor * components[name][0], components[name][1]
    for name, (quadratic, expected) in components.items():
        level = levels[name]
        # levels without a prior have one pseudo-observation, of their current value: with more,
        # the iteration ends at too large a noise
        pseudo = PSEUDO_OBSERVATIONS.get(name, 1.0)
        prior = problem.initial_levels[name] / level if name in PSEUDO_OBSERVATIONS else 1.0
        step = float(np.log(np.clip((quadratic + pseudo * prior)
                                    / (max(expected, 0.0) + pseudo), 0.03, 30.0)))
        first = RELAXATION.first if name in SLIP_LEVELS or name in PSEUDO_OBSERVATIONS else 1.0
        move = np.clip(_relaxation_exponent(pace, name, step, first) * step, np.log(0.03),
                       np.log(30.0))
        new[name] = max(level * float(np.exp(move)), problem.min_levels[name])
    for name, size in weighted[PriorRows].sizes(marginals).items() if fitted else ():
        step = float(np.log(size / levels[name]))
        new[name] = levels[name] * float(np.exp(min(_relaxation_exponent(pace, name, step, 1.0),
                                                    1.0) * step))
    return levels.replaced(**new)


def _relaxation_exponent(pace: dict[str, tuple[float, float]], name: str, step: float,
                         first: float) -> float:
    """Return the exponent of a step: larger after one in the same direction, else smaller."""
    exponent, last = pace.get(name, (first, 0.0))
    if step * last < 0:
        exponent *= RELAXATION.slower
    elif last:
        exponent *= RELAXATION.faster if exponent >= 1.0 else 1 / RELAXATION.slower
    pace[name] = min(exponent, RELAXATION.largest), step
    return pace[name][0]


def long_span_factors(fixes: Fixes, levels: Levels,
                      components: dict[str, tuple[float, float]]) -> dict[str, float]:
    """
    Return the factors, 1 or more, by which the growth of fix errors exceeds its model, (S17a).

    The largest ratio, for spans of 1, 2, 4, ... s, of the mean square of the error differences to
    its expectation plus one standard deviation; by the name of the correlated level.

    levels : of the pass.   components : quadratic sum and expectation of each level.
    """
    t, error = fixes.state.t[fixes.k] + fixes.points.tau, fixes.errors()
    stated = 1 / np.diagonal(fixes.whitening, axis1=1, axis2=2)**2
    time, out = levels.correlation_time, dict.fromkeys(SLOW_COLUMNS, 1.0)
    span = max(1.0, 2 * float(np.median(np.diff(t))))
    while t[-1] - t[0] > MIN_SPANS * span:
        end = np.searchsorted(t, t + span)
        a = np.flatnonzero(end < len(t))
        b = end[a]
        grown = float((1 - np.exp(-(t[b] - t[a]) / time)).mean())
        spans = (t[-1] - t[0]) / span
        for (name, columns), white in zip(SLOW_COLUMNS.items(), Fixes.level_columns, strict=True):
            power, noise = (levels[level] * components[level][0] / max(components[level][1], 1e-9)
                            for level in (name, white))
            expected = 2 * noise * float(stated[a, columns].mean()) + power * time * grown
            change = error[b, columns] - error[a, columns]
            chance = 1 + np.sqrt(2 / (spans * change.shape[1]))
            out[name] = max(out[name], _mean_square(change) / expected / chance)
        span *= 2
    return out


def _mean_square(change: Floats) -> float:
    """Return the mean square of changes (k, c), limited to TAIL_SIGMAS robust sigmas."""
    size = np.abs(change)
    limit = TAIL_SIGMAS * np.median(size, axis=0) / NORMAL_MEDIAN
    return float((np.minimum(size, limit)**2).mean())
