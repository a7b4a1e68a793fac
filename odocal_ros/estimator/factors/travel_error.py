# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The factor of the odometer's reading error, docs/method.md (S10): rounding at each keyframe."""

from collections.abc import Iterator

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.estimator.chain import JointMarginals, Normal
from odocal_ros.estimator.factors.factor import add_prior, Factor, LinearisationPoint
from odocal_ros.estimator.levels import LEAST, Levels, LevelSides
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import E


class TravelError(Factor):
    """Rows of the travel error at each keyframe, with one level: scale units."""

    name = 'travel'

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self.state, self.still = point.state, problem.still
        self.least = problem.least['travel']
        self.weight = once_a_rest(problem.still)

    @classmethod
    def first_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        leg = problem.leg
        least = LEAST.travel / leg.rough_scale
        level = {'travel': max(leg.travel.quantum**2 / 12, least**2)}
        return level, level

    def weigh(self, levels: Levels) -> None:
        """Compute the variance, scale units squared."""
        self.variance = max(self.least, levels['travel'])
        self.log_R = self.weight.sum() * np.log(self.variance)

    def add(self, out: Normal) -> None:
        add_prior(out, slice(None), slice(E, E + 1), self.variance,
                  self.state.travel_error[:, None], self.weight[:, None])

    def cost(self) -> float:
        out: float = (self.weight * self.state.travel_error**2).sum() / self.variance
        return out

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        e, moving = self.variance, ~self.still
        spread = marginals.variances()[:, E]
        x = self.state.travel_error[moving]
        return {'travel': (float((x**2).sum() / e), float((1 - spread[moving] / e).sum()))}

    def add_levels(self, out: LevelSides) -> None:
        i, = out.at((self.name,))
        g = self.weight * self.state.travel_error / self.variance
        out.chain[:, E, i] += g
        out.square[i, i] += g @ self.state.travel_error

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        cross = self.all_with_wanted(marginals)
        root = np.sqrt(self.weight / self.variance)
        travel = np.concatenate([cross[:, :, E], cross[-1:, :, self.n + E]]) * root[:, None]
        yield 'quantisation', travel[:, :, None]


def once_a_rest(still: Bools) -> Floats:
    """Return the weights of rounding errors, (N,): 1 for all keyframes of a standstill."""
    starts = np.flatnonzero(np.diff(still, prepend=False) & still)
    stops = np.flatnonzero(np.diff(still, append=False) & still) + 1
    weight = np.ones(len(still))
    for first, last in zip(starts, stops, strict=True):
        weight[first:last] = 1 / (last - first)
    return weight
