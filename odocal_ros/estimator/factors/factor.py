# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The interface of a factor of the likelihood: the rows (residuals) of one sensor or one prior.

A factor has the residuals at one state and their derivatives, initial and minimum noise levels,
and its terms of the normal equations, the cost, the variance components and the error budget. It
is created without weights; ``weighted_copy`` returns a copy at given noise levels.
"""

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.data.arrays import blocks, Floats
from odocal_ros.estimator.chain import JointMarginals, NormalEquations
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.preintegrate import Intervals, Points
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import Priors, SIZE_WITH_SLOW, SIZE_WITHOUT_SLOW, State

# levels of the IMU: white noises, and random walks of its biases
IMU = ('gyro', 'accel', 'gyro_walk', 'accel_walk')
# variance factors of an outlier interval, h of (S13), for the odometer forward, sideways and up
# (slips), the noises of the IMU (kerbs, aliased vibration; biases that step), and the noise that
# drives the correlated fix error (jumps of the receiver)
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
    points: dict[str, Points]  # sums up to the times of the rows, by the name of their factor
    priors: Priors
    # (K, VARIANCE_FACTOR_COUNT) factors on the variances of outlier intervals; None: 1
    variance_factors: np.ndarray | None
    fitted: bool = False       # near the solution: see ``Motion``


class Factor:
    """
    Base class of the factors, without any rows. ``equations.FACTORS`` lists the factors.

    A subclass implements ``__init__(problem, point)`` and overrides what differs. N keyframes of n
    unknowns have K = N - 1 intervals; the first m of the M constants are in use.
    """

    name: ClassVar[str]
    state: State
    levels: Levels           # of a weighted copy, as n and m
    n: int                   # unknowns of a keyframe, with or without the slow fix error
    m: int                   # number of constants in use
    log_R: float = 0.0       # log determinant of the covariance of the rows, plus a constant

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self.state = point.state

    @classmethod
    def is_present(cls, problem: Problem) -> bool:
        """Return True if a leg has rows of this factor."""
        return True

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        """Return initial values and lower limits of its noise levels, by name."""
        return {}, {}

    def is_used(self, levels: Levels) -> bool:
        """Return True if the rows exist at these levels."""
        return True

    def weighted_copy(self, levels: Levels, m: int) -> 'Factor':
        """Return a copy with weighted rows and the first m constants."""
        new = copy(self)
        new.levels, new.m = levels, m
        new.n = SIZE_WITH_SLOW if levels.correlation_time else SIZE_WITHOUT_SLOW
        new.weigh(levels)
        return new

    def weigh(self, levels: Levels) -> None:
        """Compute everything that depends on the levels."""

    def add(self, out: NormalEquations) -> None:
        """Add the rows to normal equations."""

    def apply_step(self, step: Floats, constants: Floats, new_state: State) -> None:
        """Apply a step (N, n), (M,) to the residuals, to first order; it leads to new_state."""
        self.state = new_state

    def cost(self) -> float:
        """Return the weighted sum of squares of the residuals."""
        return 0.0

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        """Return quadratic sum Q and redundancy E of (S26), by the name of the level."""
        return {}

    def add_levels(self, out: LevelRightHandSides) -> None:
        """Add the right-hand sides of its levels: docs/method.md (S27b)."""

    def effects(self, marginals: JointMarginals) -> Iterable[tuple[str, Floats]]:
        """Yield budget sources (S32), effects of unit errors on ln K, yaw, pitch: (..., 3, k)."""
        return ()

    def parameter_covariances(self, covariances: Floats) -> Floats:
        """Return covariances (k, 2n + m, 2n + m), only the rows of ln K, yaw and pitch."""
        return covariances[:, 2 * self.n:2 * self.n + PARAMETER_COUNT, :]

    def all_parameter_covariances(self, marginals: JointMarginals) -> Floats:
        """Return the cross-covariances for all intervals: (K, 3, 2n + m)."""
        # copies: a view of a few rows would keep the whole block in memory
        return np.concatenate([self.parameter_covariances(block).copy()
                               for block in marginals.blocks()])


def add_prior(out: NormalEquations, k: int | slice, columns: slice, variance: Floats | float,
              residual: Floats | float, weight: Floats | float = 1.0) -> None:
    """Add priors of columns at keyframes k; residual : value minus mean.   weight 0 : no prior."""
    i = np.arange(out.g.shape[1])[columns]
    keyframes = np.atleast_1d(np.arange(len(out.g))[k])[:, None]
    information, gradient = (np.broadcast_to(x, (len(keyframes), len(i)))
                             for x in (weight / variance, weight * residual / variance))
    for rows in blocks(len(keyframes)):
        out.diagonal[keyframes[rows], i, i] += information[rows]
        out.g[keyframes[rows], i] -= gradient[rows]


def add_process(out: NormalEquations, columns: slice, decay: Floats | float, weight: Floats,
                residual: Floats) -> None:
    """
    Add a Gauss-Markov process, or with decay 1 a random walk, of columns of the keyframes.

    weight : inverse variance of the driving noise.   residual : (K, c) this noise at the state,
    the value at the end of each interval minus decay times the value at its start.
    """
    i = np.arange(out.g.shape[1])[columns]
    shape = np.broadcast_shapes(np.shape(residual), (len(out.upper), len(i)))
    terms = (decay**2 * weight, weight, decay * weight, decay * weight * residual,
             weight * residual)
    begin, end, cross, g_begin, g_end = (np.broadcast_to(x, shape) for x in terms)
    for rows in blocks(len(out.upper)):
        out.diagonal[rows, i, i] += begin[rows]
        out.upper[rows, i, i] -= cross[rows]
        out.g[rows, i] += g_begin[rows]
    for rows in blocks(len(out.upper)):
        ends = slice(rows.start + 1, rows.stop + 1)
        out.diagonal[ends, i, i] += end[rows]
        out.g[ends, i] -= g_end[rows]
