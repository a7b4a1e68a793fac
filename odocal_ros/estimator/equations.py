# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The least-squares problem of a leg, linearised at one state.

``Equations`` has the factors (sensors and priors) at the state. ``WeightedEquations`` has them at
given noise levels, and returns the sums over all factors: normal equations, cost, variance
components. An additional sensor or prior is one more class in ``FACTORS``.
"""

from typing import TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import chain
from odocal_ros.estimator.chain import JointMarginals, NormalEquations, Solution
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
from odocal_ros.estimator.state import Priors, SIZE_WITH_SLOW, SIZE_WITHOUT_SLOW, State

SomeFactor = TypeVar('SomeFactor', bound=Factor)
FACTORS: tuple[type[Factor], ...] = (MotionRows, Fixes, VelocityRows, HeadingRows, PressureRows,
                                     SpeedSteps, TravelError, SlowError, StandstillRows, PriorRows)
# sensors besides IMU, odometer and fixes
EXTERNAL_FACTORS = tuple(kind for kind in FACTORS if issubclass(kind, ExternalRows))


def preintegrate_at(problem: Problem, state: State) -> tuple[Intervals, dict[str, Points]]:
    """Return the sums over all intervals, and up to the times of the rows of each factor."""
    times = {kind.name: kind.times(problem, state.constants) for kind in FACTORS
             if issubclass(kind, PointRows) and kind.is_present(problem)}
    all_times = np.concatenate(list(times.values()))
    order = np.argsort(all_times, kind='stable')
    intervals, points = preintegrate(
        problem.imu, state.gyro_bias[:-1], state.accel_bias[:-1],
        as_rolled(problem.leg.travel, state.constants), state.scale * state.forward,
        all_times[order], state.constants)
    # place of each time among the sorted ones, by factor
    places = np.split(np.argsort(order, kind='stable'),
                      np.cumsum([len(t) for t in times.values()])[:-1])
    return intervals, {name: points.take(rows) for name, rows in zip(times, places, strict=True)}


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


class WeightedEquations:
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

    def normal(self) -> NormalEquations:
        """Return the normal equations of the step."""
        out = NormalEquations(len(self.state.t), self.n, self.m)
        for factor in self.factors.values():
            factor.add(out)
        return out

    def solve(self) -> Solution:
        """Return the solution; raises NotPositive if the data do not determine the unknowns."""
        try:
            return chain.solve(self.normal())
        except chain.NotPositive as error:
            if error.block < 0:
                raise
            raise chain.NotPositive('the data do not determine the motion at t = '
                                    f'{self.state.t[error.block]:.1f} s') from None

    def apply_step(self, solution: Solution) -> 'WeightedEquations':
        """Move residuals, cost and components to the state after the step, to first order."""
        step, constants = solution.step, solution.step_constants
        new_state = self.state.updated(step, constants)
        for factor in self.factors.values():
            factor.apply_step(step, constants, new_state)
        return self

    def information(self, solution: Solution) -> LevelInformation:
        """
        Return the information on the levels, (S27b); call before ``solution.marginals``.

        The sizes of imperfections come last: their errors are those independent of the noises.
        """
        noises = [name for name in self.levels.values if name not in SIZES]
        sides = LevelRightHandSides(len(self.state.t), self.n, self.m, (*noises, *SIZES))
        for factor in self.factors.values():
            factor.add_levels(sides)
        fitted, derivatives = solution.quadratic_forms(sides.g, sides.g_constants)
        return LevelInformation(sides.names, (sides.q_products - fitted) / 2, derivatives)

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
