# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Scale factor and position of each wheel relative to the mean of all, docs/method.md (W1) to (W9).

The scale factor K of the fit applies to the mean reading s of the wheels that do not steer. The
reading s_i of a wheel differs from it by the turn psi of the vehicle (from the attitudes of the
fit) times its lateral position y_i, positive to the left, and by the difference of the tyres. A
steered wheel, x_i ahead of the mean, also rolls farther in turns, by x_i^2 q (W9):

    K (s_i - s) = (a_i - 1) K s - a_i y_i psi + a_i x_i^2 q,        K_i = K / a_i

This is a linear regression for each wheel, with the unknowns a_i - 1, a_i y_i and a_i x_i^2. It is
fitted to increments between nodes (wheel_regression.py). The positions include the effect of load
in turns.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, map_rows, running_sum
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.interval_noise import accelerating_and_turning
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.odometer import as_rolled, stamp_of
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.wheel_regression import (
    fit_regression,
    Increments,
    Regression,
    UNUSABLE_WALK_TIME,
)
from odocal_ros.estimator.result.wheel_result import Wheel
from odocal_ros.nav.rotations import rotvec
from odocal_ros.nav.time_series import integral_at
from odocal_ros.screening.axles import STEER_GRID, steering_path
from odocal_ros.settings.levels import TRACK_WIDTH

INITIAL_WALK = 2e-3**2    # m^2/s, definition: initial levels of the random walk
WHEEL_DELAY_SIGMA = 0.02    # s, judgement: of the stamps of a wheel relative to the others
MAX_WHEEL_STEP = 0.3      # s, judgement: interpolation errors are then 1 to 2 cm
MIN_WHEEL_INCREMENTS = 20  # judgement: with fewer, the sigma of a level is 30 % or more
NUISANCE = range(2, 5)  # definition: indices of the delays and the drift among the unknowns
# physical, relative error of x_i from sideslip and body motion: 20 mm of 2.7 m
# (docs/decisions/0022)
POSITION_ERROR = 8e-3
WHEELBASE = 5.0         # m, physical: 1 sigma of x_i of a steered wheel, of a lorry


def fit_wheels(problem: Problem, fit: Fit, covariance: Floats, drift: float,
               width: float) -> dict[str, Wheel]:
    """
    Return the wheels of a leg by name; empty with fewer than two, or with too little motion.

    covariance : (M, M) of the constants.   drift : rad/s, sigma of the gyro bias about up, by
    which the yaw of the fit drifts.   width : m, configured track width, 0: unknown.
    """
    wheels, state = problem.leg.wheels, fit.state
    if len(wheels) < 2:
        return {}
    t = stamp_of(state.t, state.constants)
    inside = np.flatnonzero((t >= max(w.t[0] for w in wheels))
                            & (t <= min(w.t[-1] for w in wheels)))
    s = np.stack([as_rolled(w, state.constants)(state.t[inside]) for w in wheels]) * state.scale
    nodes = _nodes(s, state.scale * max(w.quantum for w in wheels))
    if len(nodes) < MIN_WHEEL_INCREMENTS:
        return {}
    signals = _Signals(problem, fit, inside[nodes], s[:, nodes])
    # sigma of the delay of the odometer, in the middle of the leg
    clock, gradient = [layout.ODO_DELAY, layout.ODO_CLOCK], np.array([1.0, state.t.mean()])
    delay = float(np.sqrt(gradient @ covariance[np.ix_(clock, clock)] @ gradient))
    used = [layout.LN_K, *range(layout.GYRO.start, layout.GYRO.stop)]
    regressions = [signals.regression(i, delay, drift, width) for i in range(len(wheels))]
    return {wheel.name: _wheel(fitted, signals.by_constants(i, fitted),
                               covariance[np.ix_(used, used)])
            for i, (wheel, fitted) in enumerate(zip(wheels, regressions, strict=True))}


def _nodes(s: Floats, quantum: float) -> Ints:
    """Return the columns of readings (w, k), m, that are nodes: at least one count apart."""
    nodes = [0]
    for k in range(1, s.shape[1]):
        # m: a standstill is one node
        if np.abs(s[:, k] - s[:, nodes[-1]]).max() > max(quantum, 1e-3):
            nodes.append(k)
    return np.array(nodes)


def _unusable_times(leg: SmootherLeg) -> Iterator[tuple[float, float]]:
    """Yield times, s, without usable increments: around known slips, and gaps of a wheel."""
    for t in leg.uncertain_t:
        yield t - 1.0, t + 1.0
    for wheel in leg.wheels:
        steps = np.diff(wheel.t)
        for k in np.flatnonzero(steps > max(MAX_WHEEL_STEP, 3 * float(np.median(steps)))):
            yield wheel.t[k], wheel.t[k + 1]


class _Signals:
    """The signals of the regressions; nodes : (k,) keyframes.   s : (w, k) m, readings there."""

    def __init__(self, problem: Problem, fit: Fit, nodes: Ints, s: Floats) -> None:
        state, motion = fit.state, fit.weighted[MotionRows].motion
        self.leg, self.s = problem.leg, s
        self.fixed = np.array([not wheel.distance_ahead for wheel in self.leg.wheels])
        self.mean = s[self.fixed].mean(axis=0)
        self.path = np.diff(self.mean)
        up = state.C_bv[:, 2]
        turn = rotvec(np.swapaxes(state.C_nb[:-1], 1, 2) @ state.C_nb[1:]) @ up
        self.turn = np.diff(running_sum(turn)[nodes])
        signals = np.concatenate([motion.sums.mean_rate, motion.sums.mean_force], axis=1)
        errors = signals[:, layout.GYRO_SIGNAL] * up[list(layout.GYRO_AXIS)] * motion.T
        # effects of unit errors GYRO on the turn: (k - 1, g)
        self.turn_errors = np.diff(running_sum(errors)[nodes], axis=0)
        rate = (problem.rate_b - state.gyro_bias) @ up
        speed = np.einsum('ki,ki->k', state.v_n, state.C_nb @ state.forward)
        self.speed_change, self.rate_change = np.diff(speed[nodes]), np.diff(rate[nodes])
        accelerating, turning = accelerating_and_turning(motion)
        kind = np.where(turning, 2, np.where(accelerating, 1, 0))
        self.kind = kind[np.clip(nodes[1:] - 1, 0, len(kind) - 1)]
        self.T, self.t = np.diff(state.t[nodes]), state.t[nodes]
        # s, duration of driving: below 1 m/s in proportion to the path
        path = np.abs(np.diff(s)).max(axis=0)
        self.walk_time = np.clip(path, 0.02 * np.minimum(self.T, 1.0), self.T)
        stamp = stamp_of(self.t, state.constants)
        for begin, end in _unusable_times(problem.leg):
            self.walk_time[(stamp[1:] > begin) & (stamp[:-1] < end)] = UNUSABLE_WALK_TIME
        self.scale = state.scale
        self.steering_paths = {i: self._steering_path(state, up, i)
                               for i, fixed in enumerate(self.fixed) if not fixed}

    def _prior_y(self, i: int, width: float) -> float:
        """Return the prior y of a wheel, m: left, right of each axle, 0 of an odd last one."""
        is_left = i % 2 == 0
        if is_left and i == len(self.leg.wheels) - 1:
            return 0.0
        return (width or TRACK_WIDTH.typical) / 2 * (1 if is_left else -1)

    def _steering_path(self, state: layout.State, up: Floats, i: int) -> Floats:
        """Return the increments of q of a steered wheel, (W9): (k - 1,) 1/m."""
        leg, scale = self.leg, state.scale
        t = np.arange(self.t[0], self.t[-1], STEER_GRID)
        turn = integral_at(t, leg.t_imu, map_rows(
            lambda w_b: (w_b - state.gyro_bias.mean(axis=0)) @ up, leg.w_b))
        wheels = [wheel for wheel in leg.wheels if not wheel.distance_ahead]
        s = np.mean([as_rolled(wheel, state.constants)(t) for wheel in wheels], axis=0)
        path = steering_path(t, turn, scale * s, scale * leg.wheels[i].distance_ahead,
                             self._prior_y(i, 0.0))
        return np.diff(np.interp(self.t, t, path))

    def regression(self, i: int, delay: float, drift: float, width: float) -> Regression:
        """Return a - 1, a y, delay of the wheel, of all, drift, and a x^2 if it steers, (W1)."""
        y0 = self._prior_y(i, width)
        X = np.stack([self.path, -self.turn, self.speed_change, y0 * self.rate_change,
                      y0 * self.T], -1)
        width_sigma = TRACK_WIDTH.tape_share * width / 2
        prior = np.array([1.0, width_sigma or TRACK_WIDTH.unknown_sigma, WHEEL_DELAY_SIGMA,
                          max(delay, 1e-4), max(drift, 1e-9)])
        mean = np.array([0.0, y0 if width_sigma else 0.0, 0.0, 0.0, 0.0])
        if i in self.steering_paths:
            X = np.column_stack([X, self.steering_paths[i]])
            prior, mean = np.append(prior, WHEELBASE**2), np.append(mean, 0.0)
        weight = np.where(self.fixed, -1 / self.fixed.sum(), 0.0)
        weight[i] += 1.0
        rounding = sum((w * q.quantum * self.scale)**2 / 12 for w, q in zip(
            weight, self.leg.wheels, strict=True))
        return fit_regression(Increments(
            np.diff(self.s[i] - self.mean), X, prior, mean,
            max(float(rounding), 1e-4**2), self.walk_time, self.kind, np.full(3, INITIAL_WALK)))

    def by_constants(self, i: int, fitted: Regression) -> Floats:
        """Return the derivatives of a - 1, a y and a x^2 by ln K and GYRO, J of (W4)."""
        x, gain = fitted.x, np.delete(fitted.gain, NUISANCE, axis=0)
        by_scale, by_gyro = [0.0, x[1]], -gain @ self.turn_errors * x[1]
        if i in self.steering_paths:     # q is proportional to the squared turn over the path
            by_scale.append(2 * x[-1])
            curvature = self.turn / np.where(self.path, self.path, np.inf)
            by_gyro += gain @ (curvature[:, None] * self.turn_errors) * x[-1]
        return np.column_stack([by_scale, by_gyro])


def _wheel(fitted: Regression, by_constants: Floats, covariance_fit: Floats) -> Wheel:
    """Return a wheel with the errors of the fit, (W4), (W8)."""
    scaled = np.delete(fitted.x, NUISANCE)      # a - 1, a y, and a x^2 if it steers
    a, y = 1 + scaled[0], scaled[1] / (1 + scaled[0])
    rows = np.delete(np.arange(len(fitted.x)), NUISANCE)
    covariance = fitted.covariance[np.ix_(rows, rows)] \
        + by_constants @ covariance_fit @ by_constants.T
    gradient = np.array([-y, 1.0]) / a
    wheel = Wheel(float(1 / a), float(np.sqrt(covariance[0, 0]) / a), float(y),
                  float(np.sqrt(gradient @ covariance[:2, :2] @ gradient)),
                  tuple(np.sqrt(fitted.levels).tolist()))
    if len(scaled) == 2:
        return wheel
    x = float(np.sqrt(max(scaled[2], 0.0) / a))
    sigma = float(np.sqrt(covariance[2, 2])) / (2 * a * max(x, 0.1))
    return replace(wheel, x=x, x_sigma=float(np.hypot(sigma, POSITION_ERROR * x)))
