# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The readings of the odometer: their delay and filter, rounding error, and steps of a coarse speed.

``as_rolled`` returns the travel of the wheel from delayed and filtered readings. ``TravelError``
is the factor of the rounding error at each keyframe, docs/method.md (S10). ``SpeedSteps`` is that
of a speed in coarse steps, (S14): it is known when it changes by a step. The integral of such a
speed is not used along the path (interval_noise.py): between changes its error is up to a step.
The methods of factors are described in ``Factor`` and ``PointRows``.
"""

from collections.abc import Callable, Iterator

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, running_sum, runs
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals, NormalEquations
from odocal_ros.estimator.factors.axle import Axle, tyre_signals_at
from odocal_ros.estimator.factors.factor import add_prior, Factor, LinearisationPoint
from odocal_ros.estimator.factors.point_rows import PointRows
from odocal_ros.estimator.imu import ImuSteps
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import E, ODO_CLOCK, ODO_DELAY, ODO_LAG2
from odocal_ros.nav.coarse_speed import SpeedInstants
from odocal_ros.nav.dead_reckoning import gravity_n
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import rotate
from odocal_ros.nav.time_series import interpolated

# s to each side of a time, judgement: for the mean speed at it, some readings of an odometer
SPEED_WINDOW = 0.4
# s to each side of a time, judgement: for the derivatives of the travel at it. With a filter of
# 0.4 s, the rounding error of a counter adds twice the error of a reading
STENCIL_REACH = 0.5
# definition: times of the readings, and their weights in the second and the third derivative
STENCIL = STENCIL_REACH * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
SECOND_DERIVATIVE = np.array([1.0, 0.0, -2.0, 0.0, 1.0]) / STENCIL_REACH**2
THIRD_DERIVATIVE = np.array([-1.0, 2.0, 0.0, -2.0, 1.0]) * 4 / STENCIL_REACH**3
# definition: a first-order filter with the time constant 1: nodes of Gauss-Laguerre quadrature,
# ages less their mean, and weights
FILTER_AGES, FILTER_WEIGHTS = np.polynomial.laguerre.laggauss(5)[0] - 1, \
    np.polynomial.laguerre.laggauss(5)[1]
MIN_READING_NOISE = 1e-3    # m, physical: noise of a reading of the best odometers
MIN_FILTER_TIME = 0.2      # s, judgement: speeds closer in time differ by vibration


def stamp_of(t: Floats, constants: Floats) -> Floats:
    """Return the stamps, late by delay and clock rate, of readings measured at times t, s."""
    out: Floats = t + constants[ODO_DELAY] + constants[ODO_CLOCK] * t
    return out


def as_rolled(travel: Travel, constants: Floats) -> Callable[[Floats], Floats]:
    """
    Return the travel of the wheel as a function of time, scale units.

    A filtered reading is a weighted mean of past ones. Its weights have a mean delay D and a
    variance T^2, which is the square of the time constant for a first-order filter. The travel of
    the wheel is x(t + D) - T^2 x''(t + D) / 2 + T^3 x'''(t + D) / 3, with the third moment of such
    a filter.

    travel : of the readings.   constants : (M,), with D, s, and T^2, s^2.
    """
    square = float(constants[ODO_LAG2])
    weights = -square / 2 * SECOND_DERIVATIVE + max(square, 0.0)**1.5 / 3 * THIRD_DERIVATIVE

    def rolled(t: Floats) -> Floats:
        stamp = stamp_of(t, constants)
        # at the ends the derivative of the first and last second: there are no readings beyond
        middle = np.clip(stamp, travel.t[0] + STENCIL_REACH, travel.t[-1] - STENCIL_REACH)
        out: Floats = travel.at(stamp) + sum(
            weight * travel.at(middle + step)
            for weight, step in zip(weights.tolist(), STENCIL.tolist(), strict=True))
        return out
    return rolled


def brief_accelerations(imu: ImuSteps) -> Floats:
    """
    Return the accelerations at the keyframes that the speeds there do not show: (N, 3) m/s^2, b.

    They are the mean specific force as STENCIL weighs it, minus that between the keyframes before
    and after. Gravity and bias cancel.
    """
    t, force = imu.t_keyframes, imu.signals[:, 3:]
    speed = running_sum(force - np.diff(imu.t)[:, None] * force.sum(axis=0) / np.ptp(imu.t))
    path = running_sum((speed[1:] + speed[:-1]) / 2 * np.diff(imu.t)[:, None])
    middle = np.clip(t, t[0] + STENCIL_REACH, max(t[-1] - STENCIL_REACH, t[0] + STENCIL_REACH))
    seen = sum(weight * interpolated(middle + step, imu.t, path) for weight, step in zip(
        SECOND_DERIVATIVE.tolist(), STENCIL.tolist(), strict=True))
    return np.asarray(seen - np.gradient(speed[imu.keyframes], t, axis=0))


class TravelError(Factor):
    """Rows of the travel error at each keyframe; its level is a variance, scale units squared."""

    name = 'travel'

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self.state, self.at_rest = point.state, problem.at_rest
        self.min_variance = problem.min_levels['travel']
        self.weight = standstill_weights(problem.at_rest)

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        minimum = MIN_READING_NOISE / problem.leg.rough_scale
        level = {'travel': max(problem.leg.travel.quantum**2 / 12, minimum**2)}
        return level, level

    def weigh(self, levels: Levels) -> None:
        """Compute the variance, scale units squared."""
        self.variance = max(self.min_variance, levels['travel'])
        self.log_R = self.weight.sum() * np.log(self.variance)

    def add(self, out: NormalEquations) -> None:
        add_prior(out, slice(None), slice(E, E + 1), self.variance,
                  self.state.travel_error[:, None], self.weight[:, None])

    def cost(self) -> float:
        return float((self.weight * self.state.travel_error**2).sum() / self.variance)

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        moving = ~self.at_rest
        square = (self.state.travel_error[moving]**2).sum() / self.variance
        redundancy = 1 - marginals.variances()[:, E][moving] / self.variance
        return {'travel': (float(square), float(redundancy.sum()))}

    def add_levels(self, out: LevelRightHandSides) -> None:
        i, = out.columns((self.name,))
        g = self.weight * self.state.travel_error / self.variance
        out.g[:, E, i] += g
        out.q_products[i, i] += g @ self.state.travel_error

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        cross = self.all_parameter_covariances(marginals)
        root = np.sqrt(self.weight / self.variance)
        travel = np.concatenate([cross[:, :, E], cross[-1:, :, self.n + E]]) * root[:, None]
        yield 'quantisation', travel[:, :, None]


def standstill_weights(at_rest: Bools) -> Floats:
    """Return the weights of rounding errors, (N,), whose sum over each standstill is 1."""
    weight = np.ones(len(at_rest))
    for begin, end in runs(at_rest):
        weight[begin:end] = 1 / (end - begin)
    return weight


class SpeedSteps(PointRows):
    """Rows at speed steps: K times the odometer speed minus the forward speed at the odometer."""

    name, source = 'steps', 'speed_steps'
    level_columns = {'steps': slice(0, 1)}

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        leg, state, points = problem.leg, point.state, point.points[self.name]
        self.state, self.instants = state, _used_steps(problem)
        k, tau = points.interval, points.tau[:, None]
        # attitude at the keyframe before; attitude, velocity and forward axis at the point
        C = state.C_nb[k]
        C_nb, dv_n, g = C @ points.R, rotate(C, points.dv), gravity_n(state.p_n[k], leg.origin)
        v_n, forward_n = state.v_n[k] + dv_n + g * tau, C_nb @ state.forward
        self.arm_v = leg.odometer_arm - leg.imu_arm + state.constants[layout.ODO_ARM]
        arm_b = state.C_bv @ self.arm_v
        # at the steps, and at the earlier times that the filter needs
        speeds = (np.einsum('ki,ki->k', forward_n, v_n) + np.cross(
            points.rate, arm_b) @ state.forward).reshape(len(FILTER_AGES) + 1, -1)
        self.speed = speeds[0]
        self.by_lag = (FILTER_WEIGHTS @ speeds[1:] - self.speed) / filter_time(state.constants)**2
        at_steps = np.arange(len(self.speed))
        points = self.points = points.take(at_steps)
        self.C, C_nb, self.dv_n, self.v_n, self.forward_n, g = (
            x[at_steps] for x in (C, C_nb, dv_n, v_n, forward_n, g))
        super().__init__(problem, points)
        self.sigma = self.instants.sigma * leg.rough_scale
        self.v_b = rotate(np.swapaxes(C_nb, 1, 2), self.v_n)
        # the forward axis rotates, and an IMU beside the axle moves relative to the axle
        self.acceleration = np.einsum(
            'ki,ki->k', self.forward_n, rotate(self.C, points.force) + g)\
            + np.einsum('ki,ki->k', np.cross(points.rate, state.forward), self.v_b)\
            + np.cross(points.rate_change, arm_b) @ state.forward
        c = state.constants
        axle = Axle(problem, state)
        _, reference = axle.tyre_signals(point.intervals)
        along, left = axle.traction_acceleration(), axle.left_force(point.intervals.mean_rate)
        self.tyre_signals = tyre_signals_at(
            self.speed, state.t[self.k] - state.t[0] + points.tau, along[self.k], left[self.k],
            (points.rate @ state.C_bv[:, 2])**2) - reference
        self.scale_ratio = 1 + self.tyre_signals @ c[layout.TYRES]
        speed_by_wheel = self.instants.value + self.instants.sign * c[layout.SPEED_OFFSET]
        speed_by_wheel *= state.scale * self.scale_ratio
        # derivative by ln K. The error of the published value is multiplied by K: with derivatives
        # by that value all scales of IMU and odometer would shrink together
        self.speed_gradient = self.speed if point.fitted else speed_by_wheel
        self.raw = (speed_by_wheel - self.speed - c[layout.ODO_LAG2] * self.by_lag)[:, None]

    @classmethod
    def is_present(cls, problem: Problem) -> bool:
        return problem.leg.uses_speed_steps and len(_used_steps(problem).t) > 0

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        """Return the times of the steps, s, then the times at which the filter needs a speed."""
        stamp, keyframes = _used_steps(problem).t, problem.imu.t_keyframes
        t = stamp - constants[layout.ODO_DELAY] - constants[layout.ODO_CLOCK] * stamp
        delays = filter_time(constants) * FILTER_AGES
        return np.concatenate([t, np.clip(
            t - delays[:, None], keyframes[0], keyframes[-1]).ravel()])

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        # initial value and lower limit, factors on the variances from the step size; real steps
        # are not more regular
        return {'steps': 1.0}, {'steps': 0.25}

    def whiten(self, x: Floats, rows: slice = slice(None)) -> Floats:
        return x / self.sigma[rows, None, None]

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        state, forward_n, v_n = self.state, self.forward_n, self.v_n
        J, J_c = np.zeros((len(v_n), n)), np.zeros((len(v_n), layout.M))
        J[:, layout.V], J[:, layout.PHI] = -forward_n, -np.cross(forward_n, v_n - self.dv_n)
        J[:, layout.BA] = np.einsum('ki,kij->kj', forward_n, self.C @ self.points.A)
        arm = state.C_bv @ self.arm_v
        by_rate = np.cross(arm, state.forward)
        by_gyro = np.einsum(
            'ki,kij->kj', np.cross(forward_n, v_n), self.C @ self.points.R_by_gyro) \
            - np.einsum('ki,kij->kj', forward_n, self.C @ self.points.dv_by_gyro)
        J[:, layout.BG] = by_gyro[:, :3] + by_rate
        J_c[:, layout.GYRO] = by_gyro[:, 3:] + (by_rate[list(layout.GYRO_AXIS)]
                                              * self.points.measured[:, layout.GYRO_SIGNAL])
        K = state.scale * self.scale_ratio
        J_c[:, layout.LN_K] = self.speed_gradient
        J_c[:, layout.SPEED_OFFSET] = K * self.instants.sign
        by_ratio = self.speed_gradient / self.scale_ratio
        J_c[:, layout.TYRES] = by_ratio[:, None] * self.tyre_signals
        rate = self.points.rate
        for column, gradient in zip(layout.AXES, state.C_bv_gradient, strict=True):
            J_c[:, column] = -(self.v_b + np.cross(rate, arm)) @ gradient[:, 0] - np.cross(
                rate, gradient @ self.arm_v) @ state.forward
        J_c[:, layout.ODO_ARM] = -np.cross(state.forward, rate) @ state.C_bv
        J_c[:, layout.ODO_DELAY] = self.acceleration
        J_c[:, layout.ODO_CLOCK] = self.acceleration * self.instants.t
        J_c[:, layout.ODO_LAG2] = -self.by_lag
        J_c[:, layout.ACCEL] = np.einsum('ki,kij->kj', forward_n, self.C @ self.points.F)
        return J[:, None], J_c[:, None]


def _used_steps(problem: Problem) -> SpeedInstants:
    """Return the steps of the speed between the first and the last keyframe."""
    t, coarse = problem.imu.t_keyframes, problem.leg.travel.coarse
    assert coarse is not None, 'uses_speed_steps'
    return coarse.instants.between(t[0], t[-1])


def filter_time(constants: Floats) -> float:
    """Return the time constant of a first-order filter with the variance of its delays, s."""
    return float(np.sqrt(max(constants[layout.ODO_LAG2], MIN_FILTER_TIME**2)))


def odometer_speed(travel: Callable[[Floats], Floats], t: Floats) -> Floats:
    """Return the odometer speed at times t, means over 2 SPEED_WINDOW: (N,) scale units per s."""
    return (travel(t + SPEED_WINDOW) - travel(t - SPEED_WINDOW)) / (2 * SPEED_WINDOW)
