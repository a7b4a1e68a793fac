# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The least-squares problem of a leg at one state: factors, normal equations, cost, components.

An additional sensor or prior is one more class in ``FACTORS`` (``factor.Factor``).

Constants that change within a leg are found by a score test of the converged fit: docs/method.md
(S27c). A step of a constant at a time is one more column of the equations: that of the constant,
from this time on. Its estimate with all other unknowns free needs no second fit.
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
from odocal_ros.estimator.state import LN_K, PITCH, Priors, State, WITH_SLOW, WITHOUT_SLOW, YAW
from odocal_ros.settings.levels import FAULT_SIGMAS

SomeFactor = TypeVar('SomeFactor', bound=Factor)
FACTORS: tuple[type[Factor], ...] = (MotionRows, Fixes, VelocityRows, HeadingRows, PressureRows,
                                     SpeedSteps, TravelError, SlowError, StandstillRows, PriorRows)
EXTERNAL_FACTORS = tuple(part for part in FACTORS if issubclass(part, ExternalRows))


def preintegrate_at(problem: Problem, state: State) -> tuple[Intervals, dict[str, Points]]:
    """Return the sums over all intervals, and to the times of rows by their part."""
    leg, c = problem.leg, state.constants
    times = {part.name: part.times(problem, c) for part in FACTORS
             if issubclass(part, PointRows) and part.is_present(problem)}
    all_t = np.concatenate(list(times.values()))
    order = np.argsort(all_t, kind='stable')
    intervals, points = preintegrate(
        problem.imu, state.gyro_bias[:-1], state.accel_bias[:-1],
        as_rolled(leg.travel, c), state.scale * state.forward, all_t[order], c)
    place = np.split(np.argsort(order, kind='stable'),
                     np.cumsum([len(t) for t in times.values()])[:-1])
    return intervals, {name: points.take(own) for name, own in zip(
        times, place, strict=True)}


class Equations:
    """The factors at one linearisation point, without weights."""

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
    """
    The factors at given levels.

    After ``apply_step``, cost and components refer to the new state. ``marginals`` are those of
    ``Solved``.
    """

    def __init__(self, equations: Equations, levels: Levels) -> None:
        self.state, self.levels = equations.state, levels
        self.n = WITH_SLOW if levels.correlation_time else WITHOUT_SLOW
        self.m = equations.constants_in_use
        self.factors = {name: part.weighted_copy(levels, self.m) for name,
                      part in equations.factors.items()
                      if part.is_used(levels)}

    def __getitem__(self, kind: type[SomeFactor]) -> SomeFactor:
        return next(part for part in self.factors.values() if isinstance(part, kind))

    def normal(self) -> Normal:
        """Return the normal equations of the step."""
        out = Normal(len(self.state.t), self.n, self.m)
        for part in self.factors.values():
            part.add(out)
        return out

    def solved(self) -> Solved:
        """Return the step; raises NotPositive: the data do not determine the unknowns."""
        try:
            return solve(self.normal())
        except NotPositive as error:
            if error.block < 0:
                raise
            raise NotPositive('the data do not determine the motion at t = '
                              f'{self.state.t[error.block]:.1f} s') from None

    def apply_step(self, solved: Solved) -> 'Weighted':
        """Apply the step to the residuals, to first order; return self."""
        step, constants = solved.step, solved.step_constants
        reached = self.state.updated(step, constants)
        for part in self.factors.values():
            part.apply_step(step, constants, reached)
        return self

    def information(self, solved: Solved) -> LevelInformation:
        """Return the information on the levels, sizes last; call before ``solved.marginals``."""
        names = sorted(self.levels.values, key=SIZES.__contains__)
        sides = LevelRightHandSides(len(self.state.t), self.n, self.m, names)
        for part in self.factors.values():
            part.add_levels(sides)
        taken, moves = solved.products(sides.g, sides.g_constants)
        return LevelInformation(sides.names, (sides.square - taken) / 2, moves)

    def cost(self) -> float:
        """Return the weighted sum of squares of all rows; point rows with their robust loss."""
        return float(sum(part.cost() for part in self.factors.values()))

    def log_R_total(self) -> float:
        """Return the log determinant of the covariance of all rows that the levels change."""
        return float(sum(part.log_R for part in self.factors.values()))

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        """
        Return the quadratic sum and its expectation for each variance component: (S26).

        The restricted likelihood has its maximum where, for every component of level s with
        covariance s V, r' R^-1 s V R^-1 r equals the trace of R^-1 s V less that of the part the
        unknowns take up, P J' R^-1 s V R^-1 J (P the covariance of the unknowns).
        """
        return {name: pair for part in self.factors.values()
                for name, pair in part.components(marginals).items()}


STEP_PLACES = 15       # judgement: times of a step, at equal distances along the path
STEPPING = LN_K, YAW, PITCH      # definition: constants that are tested, the scale first
GRADUAL = 1e-3      # physical: 1 sigma of the change of the scale in a leg as tyres warm up


@dataclass(frozen=True)
class ConstantStep:
    """A change of a constant from a time, s, on: its size and sigma, relative or rad."""

    constant: int
    t: float
    size: float
    sigma: float

    @property
    def is_certain(self) -> bool:
        """Return True if noise does not explain the step."""
        return abs(self.size) > FAULT_SIGMAS * self.sigma


def find_constant_steps(weighted: Weighted, solved: Solved) -> tuple[ConstantStep, ...]:
    """Return the most significant step of each constant that has any; before ``marginals``."""
    rows = weighted[MotionRows]
    path = np.cumsum(np.linalg.norm(rows.motion.displacement, axis=1))
    at = np.searchsorted(path, path[-1] * np.arange(1, STEP_PLACES + 1) / (STEP_PLACES + 1))
    chain, border, square, score = rows.step_sides(at, STEPPING)
    left = 1 / solved.step_fraction - 1      # of the step, if it was shortened: to the minimum
    score -= left * (np.einsum('kil,ki->l', chain, solved.step)
                     + border.T @ solved.step_constants[:len(border)])
    taken, _ = solved.products(chain, border)
    of_rows, whole = np.diag(square), square - taken
    information = np.diag(whole).copy()
    scale = slice(STEP_PLACES)
    score[scale], information[scale] = _beside_gradual(score[scale], whole[scale, scale])
    information = information.reshape(len(STEPPING), STEP_PLACES)
    # standing before or after a place, or a constant that no row depends on
    known = information > 1e-9 * of_rows.reshape(information.shape)
    sigma = 1 / np.sqrt(np.where(known, information, np.inf))
    score, t = score.reshape(sigma.shape), weighted.state.t[at]
    most = np.argmax(np.abs(score) * sigma, axis=1)
    return tuple(ConstantStep(constant, float(t[k]), float(score[i, k] * sigma[i, k]**2),
                              float(sigma[i, k]))
                 for i, (constant, k) in enumerate(zip(STEPPING, most, strict=True))
                 if sigma[i].any())


def _beside_gradual(score: Floats, information: Floats) -> tuple[Floats, Floats]:
    """Return score and information of each step of the scale, beside a gradual change of it."""
    # quadratic in the path, as a sum of steps at all places, with a prior
    shares = GRADUAL / STEP_PLACES * np.vander(np.linspace(-1.0, 1.0, STEP_PLACES), 2)
    across = information @ shares
    by = np.linalg.solve(np.eye(2) + shares.T @ across,
                         np.column_stack([across.T, shares.T @ score]))
    return score - across @ by[:, -1], np.diag(information) - (across * by[:, :-1].T).sum(axis=1)
