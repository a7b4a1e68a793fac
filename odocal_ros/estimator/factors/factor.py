# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A factor of the likelihood: the residuals of one sensor or one prior.

It holds residuals and derivatives at one state, initial and minimum noise levels, and its terms of
the normal equations, the cost, the variance components and the error budget. It is created
without weights; ``weighted_copy`` returns a copy at given levels, to whose residuals
``apply_step`` applies a step.
"""

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.data.arrays import blocks, Floats
from odocal_ros.estimator.chain import JointMarginals, Normal
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.preintegrate import Intervals, Points
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import Priors, State, WITH_SLOW, WITHOUT_SLOW

# levels of the IMU: white noises, and random walks of its biases
IMU = ('gyro', 'accel', 'gyro_walk', 'accel_walk')
# variance factors of an interval: of the odometer forward, sideways and up (slips), of the noises
# of the IMU (kerbs, aliased vibration; biases that step), and of the driving noise of the
# correlated fix error (jumps of the receiver)
VARIANCE_FACTORS = ('along', 'side', 'up', *IMU, 'jump')
VARIANCE_FACTOR_COUNT, JUMP = len(VARIANCE_FACTORS), VARIANCE_FACTORS.index('jump')
ACCEL_NOISE = VARIANCE_FACTORS.index('accel')
IMU_NOISE = slice(VARIANCE_FACTORS.index('gyro'), JUMP)
GYRO_STEP, ACCEL_STEP = map(VARIANCE_FACTORS.index, ('gyro_walk', 'accel_walk'))
PARAMETER_COUNT = len(PARAMETERS)    # constants in the error budget: ln K, yaw, pitch


@dataclass(frozen=True, eq=False)
class LinearisationPoint:
    """The linearisation point of the equations: a state, and the preintegrated samples at it."""

    state: State
    intervals: Intervals
    points: dict[str, Points]  # up to the times of the rows, by the name of their factor
    priors: Priors
    # (K, VARIANCE_FACTOR_COUNT) factors on the variances of outlier intervals
    variance_factors: np.ndarray | None
    fitted: bool = False       # as for ``Motion``


class Factor:
    """
    Base class of the factors, without any rows. ``equations`` lists the factors.

    A subclass implements ``__init__(problem, point)`` and overrides what differs. With rows of its
    own it also has raw, the residuals, and ``jacobians(n)``, their derivatives by keyframes and
    constants. ``marginals`` is the result of ``Solved.marginals``, or where stated a block of it,
    (k, 2n + M, 2n + M).
    """

    name: ClassVar[str]
    state: State
    levels: Levels           # levels of a weighted factor
    n: int                   # number of unknowns of a keyframe
    m: int                   # number of constants: no row depends on later ones
    log_R: float = 0.0       # log determinant of the rows' covariance, up to a constant

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self.state = point.state

    @classmethod
    def is_present(cls, problem: Problem) -> bool:
        """Return True if a leg has such rows."""
        return True

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        """Return the initial and the minimum variances, by the names of its levels."""
        return {}, {}

    def is_used(self, levels: Levels) -> bool:
        """Return True if the rows exist at these levels."""
        return True

    def weighted_copy(self, levels: Levels, m: int) -> 'Factor':
        """Return a copy with weighted rows and the first m constants."""
        new = copy(self)
        new.levels, new.m = levels, m
        new.n = WITH_SLOW if levels.correlation_time else WITHOUT_SLOW
        new.weigh(levels)
        return new

    def weigh(self, levels: Levels) -> None:
        """Compute everything that depends on the levels."""

    def add(self, out: Normal) -> None:
        """Add the rows to normal equations."""

    def apply_step(self, step: Floats, constants: Floats, reached: State) -> None:
        """Apply a step (N, n), (M,) to the residuals, to first order."""
        self.state = reached

    def cost(self) -> float:
        """Return the weighted sum of squares of the residuals."""
        return 0.0

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        """Return the quadratic sum and the redundancy of each level, (S26)."""
        return {}

    def add_levels(self, out: LevelRightHandSides) -> None:
        """Add the right-hand sides of its levels: docs/method.md (S27b)."""

    def effects(self, marginals: JointMarginals) -> Iterable[tuple[str, Floats]]:
        """Yield the names of error sources and the effects of their unit errors: (..., 3, k)."""
        return ()

    def parameter_covariances(self, block: Floats) -> Floats:
        """Return the cross-covariance of scale, yaw, pitch and the unknowns: (k, 3, 2n + M)."""
        return block[:, 2 * self.n:2 * self.n + PARAMETER_COUNT, :]

    def all_parameter_covariances(self, marginals: JointMarginals) -> Floats:
        """Return the cross-covariance for all intervals: (K, 3, 2n + M)."""
        # copies: a view of a few rows would keep the whole block in memory
        return np.concatenate([self.parameter_covariances(block).copy()
                               for block in marginals.blocks()])


def add_prior(out: Normal, k: int | slice, columns: slice, variance: Floats | float,
              residual: Floats | float, weight: Floats | float = 1.0) -> None:
    """Add priors of single unknowns: columns at keyframes k, a slice or one."""
    i = np.arange(out.g.shape[1])[columns]
    keys = np.atleast_1d(np.arange(len(out.g))[k])
    weight, pull = (np.broadcast_to(x, (len(keys), len(i)))
                    for x in (weight / variance, weight * residual / variance))
    for rows in blocks(len(keys)):
        at = keys[rows, None]
        out.diagonal[at, i, i] += weight[rows]
        out.g[at, i] -= pull[rows]


def add_process(out: Normal, columns: slice, decay: Floats | float, weight: Floats,
                residual: Floats) -> None:
    """Add a first-order process over all intervals, (K, c): x at the end less decay times x."""
    i = np.arange(out.g.shape[1])[columns]
    all_of = np.broadcast_shapes(np.shape(residual), (len(out.upper), len(i)))
    terms = (decay**2 * weight, weight, decay * weight, decay * weight * residual,
             weight * residual)
    own, end, across, pull, pull_end = (np.broadcast_to(x, all_of) for x in terms)
    for rows in blocks(len(out.upper)):
        out.diagonal[rows, i, i] += own[rows]
        out.upper[rows, i, i] -= across[rows]
        out.g[rows, i] += pull[rows]
    for rows in blocks(len(out.upper)):
        ends = slice(rows.start + 1, rows.stop + 1)
        out.diagonal[ends, i, i] += end[rows]
        out.g[ends, i] -= pull_end[rows]
