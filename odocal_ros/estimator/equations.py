# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The least-squares problem of a leg, linearised at one state.

``Equations`` has all factors (sensors and priors) at the state, ``Weighted`` the same at given
noise levels: normal equations, cost, and variance components. An additional sensor or prior is one
more class in ``FACTORS``. ``find_constant_steps`` tests whether scale, yaw or pitch change within
the leg: docs/method.md (S27c). A step of a constant at a time is one more column of the equations,
that of the constant in all rows after this time: no second fit is needed.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals, Normal, NotPositive, solve, Solved
from odocal_ros.estimator.factors.factor import Factor, LinearisationPoint
from odocal_ros.estimator.factors.gnss import Fixes, VelocityRows
from odocal_ros.estimator.factors.heading import HeadingRows
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.odometer import as_rolled, SpeedSteps, TravelError
from odocal_ros.estimator.factors.point_rows import ExternalRows, PointRows
from odocal_ros.estimator.factors.pressure import PressureRows
from odocal_ros.estimator.factors.pseudo_observations import PriorRows, SIZES, StandstillRows
from odocal_ros.estimator.factors.slow_error import SlowError
from odocal_ros.estimator.levels import LevelInformation, LevelRightHandSides, Levels
from odocal_ros.estimator.preintegrate import Intervals, Points, preintegrate
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import (
    LN_K,
    PITCH,
    Priors,
    SIZE_WITH_SLOW,
    SIZE_WITHOUT_SLOW,
    State,
    YAW,
)
from odocal_ros.settings.levels import FAULT_SIGMAS

SomeFactor = TypeVar('SomeFactor', bound=Factor)
FACTORS: tuple[type[Factor], ...] = (MotionRows, Fixes, VelocityRows, HeadingRows, PressureRows,
                                     SpeedSteps, TravelError, SlowError, StandstillRows, PriorRows)
# sensors besides IMU, odometer and fixes
EXTERNAL_FACTORS = tuple(kind for kind in FACTORS if issubclass(kind, ExternalRows))


def preintegrate_at(problem: Problem, state: State) -> tuple[Intervals, dict[str, Points]]:
    """Return the sums over all intervals, and up to the times of the rows of each factor."""
    leg, c = problem.leg, state.constants
    times = {kind.name: kind.times(problem, c) for kind in FACTORS
             if issubclass(kind, PointRows) and kind.is_present(problem)}
    all_t = np.concatenate(list(times.values()))
    order = np.argsort(all_t, kind='stable')
    intervals, points = preintegrate(
        problem.imu, state.gyro_bias[:-1], state.accel_bias[:-1],
        as_rolled(leg.travel, c), state.scale * state.forward, all_t[order], c)
    indices = np.split(np.argsort(order, kind='stable'),
                       np.cumsum([len(t) for t in times.values()])[:-1])
    return intervals, {name: points.take(index)
                       for name, index in zip(times, indices, strict=True)}


class Equations:
    """The factors at one linearisation point, without weights; see ``LinearisationPoint``."""

    def __init__(self, problem: Problem, state: State,
                 priors: Priors | None = None, variance_factors: Floats | None = None,
                 fitted: bool = False) -> None:
        self.state = state
        point = LinearisationPoint(state, *preintegrate_at(problem, state),
                                   priors or problem.priors, variance_factors, fitted)
        self.constants_in_use = point.priors.used_count
        self.factors = {kind.name: kind(problem, point) for kind in FACTORS
                        if kind.is_present(problem)}

    def at(self, levels: Levels) -> 'Weighted':
        """Return the equations weighted by levels."""
        return Weighted(self, levels)


class Weighted:
    """The factors at given levels: equations of a step, and cost and components at the state."""

    def __init__(self, equations: Equations, levels: Levels) -> None:
        self.state, self.levels = equations.state, levels
        self.n = SIZE_WITH_SLOW if levels.correlation_time else SIZE_WITHOUT_SLOW
        self.m = equations.constants_in_use
        self.factors = {name: factor.weighted_copy(levels, self.m)
                        for name, factor in equations.factors.items() if factor.is_used(levels)}

    def __getitem__(self, kind: type[SomeFactor]) -> SomeFactor:
        """Return the factor of a class."""
        return next(factor for factor in self.factors.values() if isinstance(factor, kind))

    def normal(self) -> Normal:
        """Return the normal equations of the step."""
        out = Normal(len(self.state.t), self.n, self.m)
        for factor in self.factors.values():
            factor.add(out)
        return out

    def solved(self) -> Solved:
        """Return the solution; raises NotPositive if the data do not determine the unknowns."""
        try:
            return solve(self.normal())
        except NotPositive as error:
            if error.block < 0:
                raise
            raise NotPositive('the data do not determine the motion at t = '
                              f'{self.state.t[error.block]:.1f} s') from None

    def apply_step(self, solved: Solved) -> 'Weighted':
        """Move residuals, cost and components to the state after the step, to first order."""
        step, constants = solved.step, solved.step_constants
        new_state = self.state.updated(step, constants)
        for factor in self.factors.values():
            factor.apply_step(step, constants, new_state)
        return self

    def information(self, solved: Solved) -> LevelInformation:
        """
        Return the information on the levels, (S27b); call before ``solved.marginals``.

        The sizes of imperfections come last: their errors are those independent of the noises.
        """
        names = sorted(self.levels.values, key=lambda name: name in SIZES)
        sides = LevelRightHandSides(len(self.state.t), self.n, self.m, names)
        for factor in self.factors.values():
            factor.add_levels(sides)
        fitted, derivatives = solved.products(sides.g, sides.g_constants)
        return LevelInformation(sides.names, (sides.square - fitted) / 2, derivatives)

    def cost(self) -> float:
        """Return the weighted sum of squares of all rows; point rows with their robust loss."""
        return float(sum(factor.cost() for factor in self.factors.values()))

    def log_R_total(self) -> float:
        """Return the log determinant of the covariance of all rows that the levels change."""
        return float(sum(factor.log_R for factor in self.factors.values()))

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        """
        Return the quadratic sum and its expectation for each variance component: (S26).

        The restricted likelihood has its maximum where, for every component of level s with
        covariance s V, r' R^-1 s V R^-1 r equals the trace of R^-1 s V minus that of the part that
        the unknowns fit, P J' R^-1 s V R^-1 J (P the covariance of the unknowns).
        """
        return {name: pair for factor in self.factors.values()
                for name, pair in factor.components(marginals).items()}


STEP_PLACES = 15        # judgement: places where steps are tested, at equal distances on the path
TESTED_CONSTANTS = LN_K, YAW, PITCH      # definition: for steps; the scale first
WARMING_CHANGE = 1e-3      # physical: 1 sigma of the change of the scale in a leg as tyres warm up


@dataclass(frozen=True)
class ConstantStep:
    """A step of a constant within a leg."""

    constant: int   # index in CONSTANTS
    t: float        # s since the start mark
    size: float     # relative or rad, value after t minus value before
    sigma: float

    @property
    def is_certain(self) -> bool:
        """Return True if noise does not explain the step."""
        return abs(self.size) > FAULT_SIGMAS * self.sigma


def find_constant_steps(weighted: Weighted, solved: Solved) -> tuple[ConstantStep, ...]:
    """Return the most significant step of each constant; call before ``solved.marginals``."""
    rows = weighted[MotionRows]
    path = np.cumsum(np.linalg.norm(rows.motion.displacement, axis=1))
    at = np.searchsorted(path, path[-1] * np.arange(1, STEP_PLACES + 1) / (STEP_PLACES + 1))
    g, g_constants, square, score = rows.step_sides(at, TESTED_CONSTANTS)
    # ``solved`` may have shortened its step: the scores are those at the minimum of the equations
    remaining = 1 / solved.step_fraction - 1
    score -= remaining * (np.einsum('kil,ki->l', g, solved.step)
                          + g_constants.T @ solved.step_constants[:len(g_constants)])
    information = square - solved.products(g, g_constants)[0]
    diagonal = np.diag(information).copy()
    scale = slice(STEP_PLACES)
    score[scale], diagonal[scale] = _with_gradual_change(score[scale], information[scale, scale])
    shape = len(TESTED_CONSTANTS), STEP_PLACES
    # no information: at rest before or after the place, or a constant that no row depends on
    known = diagonal > 1e-9 * np.diag(square)
    sigma = (1 / np.sqrt(np.where(known, diagonal, np.inf))).reshape(shape)
    score, t = score.reshape(shape), weighted.state.t[at]
    largest = np.argmax(np.abs(score) * sigma, axis=1)
    return tuple(ConstantStep(constant, float(t[k]), float(score[i, k] * sigma[i, k]**2),
                              float(sigma[i, k]))
                 for i, (constant, k) in enumerate(zip(TESTED_CONSTANTS, largest, strict=True))
                 if sigma[i].any())


def _with_gradual_change(score: Floats, information: Floats) -> tuple[Floats, Floats]:
    """Return score and information of each step of the scale if it also changes gradually."""
    # equal steps at all places are a linear change over the path, steps that grow linearly a
    # quadratic one; both have a prior sigma and are eliminated
    linear_and_constant = np.vander(np.linspace(-1.0, 1.0, STEP_PLACES), 2)
    shares = WARMING_CHANGE / STEP_PLACES * linear_and_constant
    cross = information @ shares
    solution = np.linalg.solve(np.eye(2) + shares.T @ cross,
                               np.column_stack([cross.T, shares.T @ score]))
    return (score - cross @ solution[:, -1],
            np.diag(information) - (cross * solution[:, :-1].T).sum(axis=1))
