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
fitted to increments between nodes, whose errors are a random walk and reading errors. The reading
error of a node is in the increment before it and, with opposite sign, in the one after it: the
covariance of the increments is tridiagonal. The positions include the effect of load in turns.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import Floats, Ints, map_rows, running_sum
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.interval_noise import accelerating_and_turning
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.odometer import as_rolled, stamp_of
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.wheel_result import Wheel
from odocal_ros.nav.rotations import rotvec
from odocal_ros.nav.time_series import integral_at
from odocal_ros.screening.axles import STEER_GRID, steering_path
from odocal_ros.settings.levels import TRACK_WIDTH

WHEEL_DELAY_SIGMA = 0.02    # s, judgement: of the stamps of a wheel relative to the others
FIRST_WALK = 2e-3**2    # m^2/s, definition: initial levels of the random walk
UNUSABLE_SHARE = 1e10   # s, definition: ``Increments.share`` without information
LONGEST_STEP = 0.3      # s, judgement: interpolation errors are then 1 to 2 cm
MIN_WHEEL_INCREMENTS = 20  # judgement: with fewer, the sigma of a level is 30 % or more
NUISANCE = range(2, 5)  # definition: indices of the delays and the drift among the unknowns
# physical, relative error of x_i by sideslip and body motion: 20 mm of 2.7 m (docs/decisions/0022)
POSITION_ERROR = 8e-3
WHEELBASE = 5.0         # m, physical: 1 sigma of x_i of a steered wheel, of a lorry
# judgement: prior sigmas of the logarithms of the levels: mean of the walks about the initial
# value, each walk about their mean, and reading errors about those of rounding
WALK_SPREAD, APART_SPREAD, READING_SPREAD = 7.0, 1.0, 0.5
# of those logarithms, definition: wheels of a forecast have no noise, and their levels would
# decrease until the equations are singular
MIN_LOG_LEVEL = -20.0
# judgement: iterations of the search for outliers, until variances change by less than a tenth;
# each removes nine tenths of their effect on a level
TAIL_ROUNDS, TAIL_SETTLED = 8, 0.1


@dataclass(frozen=True, eq=False)
class Increments:
    """The observations y = X x + errors of one wheel, with their noise, (W5)."""

    y: Floats       # (k,) m, increments of the reading of a wheel minus the mean
    X: Floats       # (k, p)
    prior: Floats   # (p,) prior sigmas of x, inf: none
    mean: Floats    # (p,) prior means of x
    reading: float  # m^2, initial variance of the reading error at a node
    share: Floats   # (k,) s, variance of the walk in each increment per level
    kind: Ints      # (k,) index of its level: 0 constant speed, 1 acceleration, 2 turns
    walk: Floats    # (3,) m^2/s, initial levels


@dataclass(frozen=True, eq=False)
class Line:
    """The estimate of x."""

    x: Floats           # (p,)
    covariance: Floats  # (p, p)
    levels: Floats      # (3,) m^2/s, of the walk
    gain: Floats        # (p, k) derivatives of x by y


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
    if len(inside) < MIN_WHEEL_INCREMENTS:
        return {}
    s = np.stack([as_rolled(w, state.constants)(state.t[inside]) for w in wheels]) * state.scale
    at = _nodes(s, state.scale * max(w.quantum for w in wheels))
    if len(at) < MIN_WHEEL_INCREMENTS:
        return {}
    signals = _Signals(problem, fit, inside[at], s[:, at])
    clock = np.array([layout.ODO_DELAY, layout.ODO_CLOCK])
    row = np.array([1.0, state.t.mean()])
    delay = float(np.sqrt(row @ covariance[np.ix_(clock, clock)] @ row))
    used = [layout.LN_K, *range(layout.GYRO.start, layout.GYRO.stop)]
    lines = [signals.line(i, delay, drift, width) for i in range(len(wheels))]
    return {wheel.name: _wheel(line, signals.by_constants(i, line), covariance[np.ix_(used, used)])
            for i, (wheel, line) in enumerate(zip(wheels, lines, strict=True))}


def _nodes(s: Floats, quantum: float) -> Ints:
    """Return the columns of readings (w, k), m, that are nodes: at least one count apart."""
    nodes = [0]
    for k in range(1, s.shape[1]):
        # m: a standstill is one node
        if np.abs(s[:, k] - s[:, nodes[-1]]).max() > max(quantum, 1e-3):
            nodes.append(k)
    return np.array(nodes)


def _unknown(leg: SmootherLeg) -> Iterator[tuple[float, float]]:
    """Yield times, s, without usable increments: around known slips, and gaps of a wheel."""
    for t in leg.uncertain_t:
        yield t - 1.0, t + 1.0
    for wheel in leg.wheels:
        steps = np.diff(wheel.t)
        for k in np.flatnonzero(steps > max(LONGEST_STEP, 3 * float(np.median(steps)))):
            yield wheel.t[k], wheel.t[k + 1]


class _Signals:
    """The columns of all regressions; at : (k,) nodes.   s : (w, k) m, readings there."""

    def __init__(self, problem: Problem, fit: Fit, at: Ints, s: Floats) -> None:
        state, motion = fit.state, fit.weighted[MotionRows].motion
        self.leg, self.s = problem.leg, s
        self.fixed = np.array([not wheel.distance_ahead for wheel in self.leg.wheels])
        self.mean = s[self.fixed].mean(axis=0)
        self.path = np.diff(self.mean)
        up = state.C_bv[:, 2]
        turn = rotvec(np.swapaxes(state.C_nb[:-1], 1, 2) @ state.C_nb[1:]) @ up
        self.turn = np.diff(running_sum(turn)[at])
        signals = np.concatenate([motion.sums.mean_rate, motion.sums.mean_force], axis=1)
        errors = signals[:, layout.GYRO_SIGNAL] * up[list(layout.GYRO_AXIS)] * motion.T
        # effects of unit errors GYRO on the turn: (k - 1, g)
        self.turn_errors = np.diff(running_sum(errors)[at], axis=0)
        rate = (problem.rate_b - state.gyro_bias) @ up
        speed = np.einsum('ki,ki->k', state.v_n, state.C_nb @ state.forward)
        self.speed_change, self.rate_change = np.diff(speed[at]), np.diff(rate[at])
        hard, turns = accelerating_and_turning(motion)
        kind = np.where(turns, 2, np.where(hard, 1, 0))
        self.kind = kind[np.clip(at[1:] - 1, 0, len(kind) - 1)]
        self.T, self.t = np.diff(state.t[at]), state.t[at]
        # s of driving, less below 1 m/s
        path = np.abs(np.diff(s)).max(axis=0)
        self.share = np.clip(path, 0.02 * np.minimum(self.T, 1.0), self.T)
        stamp = stamp_of(self.t, state.constants)
        for begin, end in _unknown(problem.leg):
            self.share[(stamp[1:] > begin) & (stamp[:-1] < end)] = UNUSABLE_SHARE
        self.scale = state.scale
        self.steer = {i: self._steering(state, up, i) for i, fixed in enumerate(self.fixed)
                      if not fixed}

    def _left(self, i: int, width: float) -> float:
        """Return the prior y of a wheel, m: left, right of each axle, 0 of an odd last one."""
        alone = i == len(self.leg.wheels) - 1 and i % 2 == 0
        return 0.0 if alone else (width or TRACK_WIDTH.of_a_car) / 2 * (1 if i % 2 == 0 else -1)

    def _steering(self, state: layout.State, up: Floats, i: int) -> Floats:
        """Return the increments of q of a steered wheel, (W9): (k - 1,) 1/m."""
        leg, scale = self.leg, state.scale
        t = np.arange(self.t[0], self.t[-1], STEER_GRID)
        turn = integral_at(t, leg.t_imu, map_rows(
            lambda w_b: (w_b - state.gyro_bias.mean(axis=0)) @ up, leg.w_b))
        wheels = [wheel for wheel in leg.wheels if not wheel.distance_ahead]
        s = np.mean([as_rolled(wheel, state.constants)(t) for wheel in wheels], axis=0)
        path = steering_path(t, turn, scale * s, scale * leg.wheels[i].distance_ahead,
                             self._left(i, 0.0))
        return np.diff(np.interp(self.t, t, path))

    def line(self, i: int, delay: float, drift: float, width: float) -> Line:
        """Return a - 1, a y, delay of the wheel, of all, drift, and a x^2 if it steers, (W1)."""
        y0 = self._left(i, width)
        X = np.stack([self.path, -self.turn, self.speed_change, y0 * self.rate_change,
                      y0 * self.T], -1)
        width_sigma = TRACK_WIDTH.taped_share * width / 2
        prior = np.array([1.0, width_sigma or TRACK_WIDTH.any_sigma, WHEEL_DELAY_SIGMA,
                          max(delay, 1e-4), max(drift, 1e-9)])
        mean = np.array([0.0, y0 if width_sigma else 0.0, 0.0, 0.0, 0.0])
        if i in self.steer:
            X = np.column_stack([X, self.steer[i]])
            prior, mean = np.append(prior, WHEELBASE**2), np.append(mean, 0.0)
        weight = np.where(self.fixed, -1 / self.fixed.sum(), 0.0)
        weight[i] += 1.0
        rounding = sum((w * q.quantum * self.scale)**2 / 12 for w, q in zip(
            weight, self.leg.wheels, strict=True))
        return fit_line(Increments(
            np.diff(self.s[i] - self.mean), X, prior, mean,
            max(float(rounding), 1e-4**2), self.share, self.kind, np.full(3, FIRST_WALK)))

    def by_constants(self, i: int, line: Line) -> Floats:
        """Return the derivatives of a - 1, a y and a x^2 by ln K and GYRO, J of (W4)."""
        rows = [0, 1, *range(NUISANCE.stop, len(line.x))]
        by_scale, by_gyro = [0.0, line.x[1]], -line.gain[rows] @ self.turn_errors * line.x[1]
        if i in self.steer:     # q is proportional to the square of the turn over the path
            by_scale.append(2 * line.x[-1])
            curvature = self.turn / np.where(self.path, self.path, np.inf)
            by_gyro += line.gain[rows] @ (curvature[:, None] * self.turn_errors) * line.x[-1]
        return np.column_stack([by_scale, by_gyro])


def _wheel(line: Line, by_constants: Floats, covariance_fit: Floats) -> Wheel:
    """Return a wheel with the errors of the fit, (W4), (W8)."""
    rows = [k for k in range(len(line.x)) if k not in NUISANCE]
    a, y = 1 + line.x[0], line.x[1] / (1 + line.x[0])
    covariance = line.covariance[np.ix_(rows, rows)] \
        + by_constants @ covariance_fit @ by_constants.T
    gradient = np.array([-y, 1.0]) / a
    wheel = Wheel(float(1 / a), float(np.sqrt(covariance[0, 0]) / a), float(y),
                  float(np.sqrt(gradient @ covariance[:2, :2] @ gradient)),
                  tuple(np.sqrt(line.levels).tolist()))
    if len(rows) == 2:
        return wheel
    x = float(np.sqrt(max(line.x[-1], 0.0) / a))
    sigma = float(np.sqrt(covariance[2, 2])) / (2 * a * max(x, 0.1))
    return replace(wheel, x=x, x_sigma=float(np.hypot(sigma, POSITION_ERROR * x)))


def fit_line(data: Increments) -> Line:
    """Return the estimate at the maximum of the restricted likelihood, (W6), without outliers."""
    from scipy.optimize import minimize
    factor = np.ones(len(data.y))      # on the variances of outliers, u of (W7)
    log_levels = np.zeros(len(data.walk) + 1)
    for _ in range(TAIL_ROUNDS):
        simplex = log_levels + np.concatenate([np.zeros((1, len(log_levels))), -2 * np.eye(
            len(log_levels))])
        minimum = minimize(_minus_log_likelihood, log_levels, args=(data, factor),
                           method='Nelder-Mead', options={
                               'xatol': 0.05, 'fatol': 0.02, 'initial_simplex': simplex})
        log_levels = np.maximum(minimum.x, MIN_LOG_LEVEL)
        x, covariance, _, banded, root = _solve(log_levels, data, factor)
        z = _leave_one_out(banded, root, data.y - data.X @ x)
        before, factor = factor, np.maximum(factor * (z / TAIL_SIGMAS)**2, 1.0)
        if np.allclose(factor, before, rtol=TAIL_SETTLED):
            break
    gain = covariance @ cho_solve_banded((root, False), data.X, check_finite=False).T
    return Line(x, covariance, data.walk * np.exp(log_levels[:-1]), gain)


def _solve(log_levels: Floats, data: Increments,
           factor: Floats) -> tuple[Floats, Floats, float, Floats, Floats]:
    """Return x, its covariance, -2 ln likelihood, and the banded covariance of y and its root."""
    levels = np.exp(np.maximum(log_levels, MIN_LOG_LEVEL))
    reading = data.reading * levels[-1]
    walk = (data.walk * levels[:-1])[data.kind] * data.share * factor
    banded = np.empty((2, len(data.y)))
    banded[0], banded[1] = -reading, walk + 2 * reading
    root = cholesky_banded(banded, check_finite=False)
    both = np.column_stack([data.X, data.y - data.X @ data.mean])
    inverse = both.T @ cho_solve_banded((root, False), both, check_finite=False)
    information = inverse[:-1, :-1] + np.diag(1 / data.prior**2)
    covariance = np.linalg.inv(information)
    step = covariance @ inverse[:-1, -1]
    cost = (2 * np.log(root[1]).sum() + np.linalg.slogdet(information)[1] + inverse[-1, -1]
            - step @ information @ step)
    return data.mean + step, covariance, float(cost), banded, root


def _minus_log_likelihood(log_levels: Floats, data: Increments, factor: Floats) -> float:
    """Return minus (W6), with the priors of the levels."""
    walk, reading = log_levels[:-1], log_levels[-1]
    prior = (walk.mean()**2 / WALK_SPREAD**2 + ((walk - walk.mean())**2).sum() / APART_SPREAD**2
             + reading**2 / READING_SPREAD**2)
    return (_solve(log_levels, data, factor)[2] + float(prior)) / 2


def _leave_one_out(banded: Floats, root: Floats, residual: Floats) -> Floats:
    """Return the leave-one-out residuals of the increments, in sigmas, z of (W7): (k,)."""
    weighted = cho_solve_banded((root, False), residual, check_finite=False)
    before, after = banded[1].copy(), banded[1].copy()
    square, k = banded[0, -1]**2, len(residual)
    for i in range(1, k):
        before[i] -= square / before[i - 1]
        after[k - 1 - i] -= square / after[k - i]
    z: Floats = weighted * np.sqrt(before + after - banded[1])
    return z
