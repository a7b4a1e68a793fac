# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The steps of a coarse speed as rows, docs/method.md (S14): the speed where the value sent changes.

The integral of such a speed is not used along the vehicle (interval_noise.py): its error is that
of a cell while the value does not change.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.axle import Axle, varies_with
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.motion import gravity_n
from odocal_ros.estimator.factors.point_rows import PointRows
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import (
    ACCEL,
    BA,
    BG,
    GYRO,
    GYRO_AXIS,
    GYRO_SIGNAL,
    LN_K,
    M,
    ODO_ARM,
    ODO_CLOCK,
    ODO_DELAY,
    PHI,
    PITCH,
    SPEED_OFFSET,
    TYRES,
    V,
    YAW,
)
from odocal_ros.nav.coarse_speed import SpeedInstants
from odocal_ros.nav.rotations import turn


class SpeedSteps(PointRows):
    """Residuals of speeds, by K what the odometer says less that of its point; one component."""

    name, source = 'steps', 'speed_steps'
    levels_of = {'steps': slice(0, 1)}

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        leg, state, points = problem.leg, point.state, point.points[self.name]
        super().__init__(points)
        self.state, self.points, self.instants = state, points, _within(problem)
        self.sigma = self.instants.sigma * leg.rough_scale
        # at an even acceleration the speed is at the same place of its cell again and again
        self.per_effective = problem.per_effective.get(self.name, 1.0)
        C, tau = state.C_nb[self.k], points.tau[:, None]
        self.C, self.C_t = C, C @ points.R
        self.dv = turn(C, points.dv)
        g = gravity_n(state.p_n[self.k], leg.origin)
        self.v_n = state.v_n[self.k] + self.dv + g * tau
        self.ahead = self.C_t @ state.forward
        self.arm_v = leg.odometer_arm - leg.imu_arm + state.constants[ODO_ARM]
        arm_b = state.C_bv @ self.arm_v
        swing = np.cross(points.rate, arm_b)
        self.speed = np.einsum('ki,ki->k', self.ahead, self.v_n) + swing @ state.forward
        self.v_b = turn(np.swapaxes(self.C_t, 1, 2), self.v_n)
        # the forward axis turns too, and the IMU, beside the axle, moves across it
        self.gained = np.einsum('ki,ki->k', self.ahead, turn(C, points.force) + g) + np.einsum(
            'ki,ki->k', np.cross(points.rate, state.forward), self.v_b) + np.cross(
                points.spin, arm_b) @ state.forward
        c = state.constants
        axle = Axle(problem, state)
        self.from_mean = varies_with(
            self.speed, state.t[self.k] - state.t[0] + points.tau, axle.acceleration()[self.k]
        ) - axle.means_by_way(point.intervals)
        self.varied = 1 + self.from_mean @ c[TYRES]
        said = self.instants.value + self.instants.side * c[SPEED_OFFSET]
        self.said = state.scale * self.varied * said
        self.raw = (self.said - self.speed)[:, None]

    @classmethod
    def there(cls, problem: Problem) -> bool:
        """Return True if the odometer publishes a coarse speed."""
        return problem.leg.by_steps and len(_within(problem).t) > 0

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        """Return the times of the steps, s."""
        t = _within(problem).t
        out: Floats = t - constants[ODO_DELAY] - constants[ODO_CLOCK] * t
        return out

    @classmethod
    def first_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        """
        Return the first level, a factor on the variances by the grid, and the least.

        A quarter of the variance is the least: no vehicle crosses the edges more evenly.
        """
        return {'steps': 1.0}, {'steps': 0.25}

    def stated(self, rows: Floats) -> Floats:
        """Return rows in the sigmas that the grid gives."""
        return rows / self.sigma[:, None, None]

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        """Return derivatives by the keyframe before and by constants: (m, 1, n), (m, 1, M)."""
        state, ahead, v = self.state, self.ahead, self.v_n
        J, c = np.zeros((len(v), n)), np.zeros((len(v), M))
        J[:, V], J[:, PHI] = -ahead, -np.cross(ahead, v - self.dv)
        J[:, BA] = np.einsum('ki,kij->kj', ahead, self.C @ self.points.A)
        arm = state.C_bv @ self.arm_v
        by_rate = np.cross(arm, state.forward)
        by_gyro = np.einsum('ki,kij->kj', np.cross(ahead, v), self.C @ self.points.turned) \
            - np.einsum('ki,kij->kj', ahead, self.C @ self.points.dv_by)
        J[:, BG] = by_gyro[:, :3] + by_rate
        c[:, GYRO] = by_gyro[:, 3:] + (by_rate[list(GYRO_AXIS)]
                                       * self.points.measured[:, GYRO_SIGNAL])
        K = state.scale * self.varied
        # by what is said: the speed lies anywhere in its cell, so the error is the speed's alone
        c[:, LN_K], c[:, SPEED_OFFSET] = self.said, K * self.instants.side
        c[:, TYRES] = (self.said / self.varied)[:, None] * self.from_mean
        rate = self.points.rate
        for column, gradient in zip((YAW, PITCH), state.C_bv_gradient, strict=True):
            c[:, column] = -(self.v_b + np.cross(rate, arm)) @ gradient[:, 0] - np.cross(
                rate, gradient @ self.arm_v) @ state.forward
        c[:, ODO_ARM] = -np.cross(state.forward, rate) @ state.C_bv
        c[:, ODO_DELAY], c[:, ODO_CLOCK] = self.gained, self.gained * self.instants.t
        c[:, ACCEL] = np.einsum('ki,kij->kj', ahead, self.C @ self.points.F)
        return J[:, None], c[:, None]


def _within(problem: Problem) -> SpeedInstants:
    """Return the steps of the speed within the keyframes."""
    t, coarse = problem.imu.t[problem.imu.key], problem.leg.travel.coarse
    assert coarse is not None, 'by_steps'
    return coarse.instants.between(t[0], t[-1])
