# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Steps of the noise levels towards the maximum of the restricted likelihood, (S26) to (S29).

``LevelSteps.update`` returns new levels from the residuals of a pass (docs/method.md).

The errors of a receiver with a filter grow in proportion to time, those of the model (a
Gauss-Markov process) with its root: differences of adjacent fixes then underestimate them. The
growth over longer spans is therefore compared with that of the model, (S17a).
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.equations import WeightedEquations
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.factors.pseudo_observations import PriorRows, SIZE_SPREADS, SIZES
from odocal_ros.estimator.factors.slow_error import TIME_SPREAD
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.time_series import NORMAL_MEDIAN

# spans in a leg, minimum: statistical, with two axes, the sigma of their variance is then 35 %
MIN_SPANS = 8
# components of (east, north, up) to which each level of the correlated fix error applies
SLOW_COLUMNS = {'slow': slice(0, 2), 'slow_up': slice(2, 3)}
# judgement: initial exponent h of (S27), since the fixed-point iteration converges slowly for
# small noises (from 2 on a single level oscillates), and the largest one
FIRST_EXPONENT, MAX_EXPONENT = 1.6, 3.0
# judgement: factors on the exponent after a step in the same direction, and in the opposite one.
# The latter is undone by the next step in the same direction: a small exponent converges slowly
# (with SAME_DIRECTION instead: 1.04 times the iterations)
SAME_DIRECTION, OPPOSITE_DIRECTION = 1.25, 0.5
# pseudo-observations of the prior of an IMU level. Judgement: equivalent to a few seconds
PSEUDO_OBSERVATIONS = {'gyro': 5.0, 'accel': 5.0, 'gyro_walk': 3.0, 'accel_walk': 3.0}
# levels with a slip factor
SLIP_LEVELS = ('along', 'along_hard', 'side', 'side_turn', 'up')


def prior_information(levels: Levels) -> dict[str, float]:
    """Return the prior information on the logarithm of each level, by name: N of (S27b)."""
    return {name: SIZE_SPREADS[name]**-2 if name in SIZES
            else TIME_SPREAD**-2 if name == 'correlation_time'
            else PSEUDO_OBSERVATIONS.get(name, 1.0) / 2 for name in levels.values}


class LevelSteps:
    """The steps of the levels of a fit; each level has an exponent, adapted from pass to pass."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._last: dict[str, tuple[float, float]] = {}      # exponent and step before, by level

    def update(self, weighted: WeightedEquations, marginals: JointMarginals,
               fitted: bool) -> Levels:
        """
        Return the levels after one step of (S27); sizes of imperfections by (S29).

        fitted : residuals are noise; otherwise they depend on the initial state, and the sizes
        are kept.
        """
        new, levels, components = {}, weighted.levels, weighted.components(marginals)
        if 'slow' in components and 'fix' in components:
            for name, factor in long_span_factors(weighted[Fixes], levels, components).items():
                components[name] = factor * components[name][0], components[name][1]
        for name, (quadratic, expected) in components.items():
            # levels without a prior have one pseudo-observation, of their current value: with
            # more, the iteration ends at too large a noise
            has_prior = name in PSEUDO_OBSERVATIONS
            count = PSEUDO_OBSERVATIONS.get(name, 1.0)
            prior = self._problem.initial_levels[name] / levels[name] if has_prior else 1.0
            step = float(np.log(np.clip((quadratic + count * prior)
                                        / (max(expected, 0.0) + count), 0.03, 30.0)))
            first = FIRST_EXPONENT if has_prior or name in SLIP_LEVELS else 1.0
            log_ratio = np.clip(self._exponent(name, step, first) * step,
                                np.log(0.03), np.log(30.0))
            new[name] = max(levels[name] * float(np.exp(log_ratio)),
                            self._problem.min_levels[name])
        for name, size in weighted[PriorRows].sizes(marginals).items() if fitted else ():
            step = float(np.log(size / levels[name]))
            new[name] = levels[name] * float(np.exp(min(self._exponent(name, step, 1.0), 1.0)
                                                    * step))
        return levels.replaced(**new)

    def _exponent(self, name: str, step: float, first: float) -> float:
        """Return the exponent of a step: larger after one in the same direction, else smaller."""
        exponent, last = self._last.get(name, (first, 0.0))
        if step * last < 0:
            exponent *= OPPOSITE_DIRECTION
        elif last:
            exponent *= SAME_DIRECTION if exponent >= 1.0 else 1 / OPPOSITE_DIRECTION
        self._last[name] = min(exponent, MAX_EXPONENT), step
        return self._last[name][0]


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
        a = np.flatnonzero(end < len(t))        # rows at the starts and ends of the spans
        b = end[a]
        growth = float((1 - np.exp(-(t[b] - t[a]) / time)).mean())
        spans = (t[-1] - t[0]) / span
        for (name, columns), white in zip(SLOW_COLUMNS.items(), Fixes.level_columns, strict=True):
            power, noise = (levels[level] * components[level][0] / max(components[level][1], 1e-9)
                            for level in (name, white))
            expected = 2 * noise * float(stated[a, columns].mean()) + power * time * growth
            change = error[b, columns] - error[a, columns]
            limit = 1 + np.sqrt(2 / (spans * change.shape[1]))      # plus one standard deviation
            out[name] = max(out[name], _mean_square(change) / expected / limit)
        span *= 2
    return out


def _mean_square(change: Floats) -> float:
    """Return the mean square of changes (k, c), limited to TAIL_SIGMAS robust sigmas."""
    size = np.abs(change)
    limit = TAIL_SIGMAS * np.median(size, axis=0) / NORMAL_MEDIAN
    return float((np.minimum(size, limit)**2).mean())
