# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Factor and position of each wheel relative to the mean, docs/method.md (W1) to (W7).

The scale factor of the fit applies to the mean reading of the wheels that do not steer. The
reading of a wheel differs from the mean by the turn times the wheel's distance from the middle,
and by the difference of the tyres; a steered wheel also rolls farther in turns, (W9):

    K (s_i - s) = (a_i - 1) K s - a_i y_i psi + a_i x_i^2 q,        K_i = K / a_i

s_i and s the readings of wheel i and of the mean, psi the turn, y_i the wheel's place, positive to
the left, x_i its distance ahead. The turn is from the attitudes of the fit; each wheel has one
line. The positions include the effect of load in turns: the outer tyre has a higher load and a
smaller rolling radius.

The line is fitted to increments with a random walk and reading errors. The reading error at a node
is in the increment that ends there and, with opposite sign, in the one that begins there: the
covariance of the increments is tridiagonal, and reading errors do not accumulate.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import by_row, Floats, Ints, running_sum
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

OWN_DELAY = 0.02        # s, 1 sigma of a wheel's stamps against the others'. Judgement
FIRST_WALK = 2e-3**2    # m^2/s, definition: first levels
DOUBTED = 1e10          # definition: share of a walk that removes the information of an increment
GAP = 0.3               # s, judgement: interpolation errors are then 1 to 2 cm
FEWEST = 20             # increments, judgement: with fewer, the sigma of a level is 30 % or more
NUISANCE = range(2, 5)  # definition: nuisance parameters of a line
# physical: 1 sigma of it by sideslip and body motion; 20 mm of 2.7 m in docs/decisions/0022
PLACE_SHARE = 8e-3
WHEELBASE = 5.0         # m, 1 sigma of the distance of a steered wheel ahead. Physical: of a lorry
# prior sigmas of the logarithm of a level: all walks together may differ by a factor of a thousand
# from their first value, each from their mean by three; reading errors are those of rounding.
# Judgement
WALK_SPREAD, APART_SPREAD, READING_SPREAD = 7.0, 1.0, 0.5
# judgement: iterations of the search for outliers, until variances change by less than a tenth;
# each removes nine tenths of their effect on a level
TAIL_ROUNDS, TAIL_SETTLED = 8, 0.1


@dataclass(frozen=True, eq=False)
class Increments:
    """The observations y = X x + errors, in m."""

    y: Floats       # (k,)
    X: Floats       # (k, p)
    prior: Floats   # (p,) sigmas of x about ``centre``, inf: none
    centre: Floats  # (p,)
    reading: float  # m^2, variance of the error at a node
    share: Floats   # (k,) variance of the walk in each increment at a level of 1
    kind: Ints      # (k,) index of its level
    walk: Floats    # m^2, first levels


@dataclass(frozen=True, eq=False)
class Line:
    """The line found."""

    x: Floats           # (p,)
    covariance: Floats  # (p, p)
    levels: Floats      # m^2, of the walk
    gain: Floats        # (p, k) derivatives of x by the increments


def wheels_beside(problem: Problem, fit: Fit, covariance: Floats, drift: float,
                  width: float) -> dict[str, Wheel]:
    """
    Return the wheels of a leg by name; empty with fewer than two, or with too little motion.

    problem, fit : the leg and its fit.   covariance : (M, M) of the constants.   drift : sigma of
    the gyro bias about up, rad/s: the yaw of the fit drifts by it.   width : track width
    as set, m, 0: unknown.
    """
    wheels, state = problem.leg.wheels, fit.state
    if len(wheels) < 2:
        return {}
    t = stamp_of(state.t, state.constants)
    inside = np.flatnonzero((t >= max(w.t[0] for w in wheels))
                            & (t <= min(w.t[-1] for w in wheels)))
    if len(inside) < FEWEST:
        return {}
    s = np.stack([as_rolled(w, state.constants)(state.t[inside]) for w in wheels]) * state.scale
    at = _nodes(s, state.scale * max(w.quantum for w in wheels))
    if len(at) < FEWEST:
        return {}
    common = _Common(problem, fit, inside[at], s[:, at])
    late = np.array([layout.ODO_DELAY, layout.ODO_CLOCK])
    row = np.array([1.0, state.t.mean()])
    delay = float(np.sqrt(row @ covariance[np.ix_(late, late)] @ row))
    own = [layout.LN_K, *range(layout.GYRO.start, layout.GYRO.stop)]
    lines = [common.line(i, delay, drift, width) for i in range(len(wheels))]
    return {wheel.name: _wheel(line, common.moved(i, line), covariance[np.ix_(own, own)])
            for i, (wheel, line) in enumerate(zip(wheels, lines, strict=True))}


def _nodes(s: Floats, quantum: float) -> Ints:
    """Return the nodes at which readings (w, k) are compared: at least one count apart."""
    nodes = [0]
    for k in range(1, s.shape[1]):
        # m: a standstill is one node
        if np.abs(s[:, k] - s[:, nodes[-1]]).max() > max(quantum, 1e-3):
            nodes.append(k)
    return np.array(nodes)


def _unknown(leg: SmootherLeg) -> Iterator[tuple[float, float]]:
    """Yield spans without usable increments: known slips and gaps of a wheel, s."""
    for t in leg.uncertain_t:
        yield t - 1.0, t + 1.0
    for wheel in leg.wheels:
        steps = np.diff(wheel.t)
        for k in np.flatnonzero(steps > max(GAP, 3 * float(np.median(steps)))):
            yield wheel.t[k], wheel.t[k + 1]


class _Common:
    """Quantities shared by the lines of all wheels; s : (w, k) readings at the nodes, m."""

    def __init__(self, problem: Problem, fit: Fit, at: Ints, s: Floats) -> None:
        state, motion = fit.state, fit.weighted[MotionRows].motion
        self.leg, self.s = problem.leg, s
        self.fixed = np.array([not wheel.ahead for wheel in self.leg.wheels])
        self.mean = s[self.fixed].mean(axis=0)
        self.path = np.diff(self.mean)
        up = state.C_bv[:, 2]
        turn = rotvec(np.swapaxes(state.C_nb[:-1], 1, 2) @ state.C_nb[1:]) @ up
        self.turn = np.diff(running_sum(turn)[at])
        signals = np.concatenate([motion.sums.mean_rate, motion.sums.mean_force], axis=1)
        errors = signals[:, layout.GYRO_SIGNAL] * up[list(layout.GYRO_AXIS)] * motion.T
        # by units of the gyro's errors
        self.turn_errors = np.diff(running_sum(errors)[at], axis=0)
        rate = (problem.rate_b - state.gyro_bias) @ up
        speed = np.einsum('ki,ki->k', state.v_n, state.C_nb @ state.forward)
        self.faster, self.turning = np.diff(speed[at]), np.diff(rate[at])
        hard, turns = accelerating_and_turning(motion)
        kind = np.where(turns, 2, np.where(hard, 1, 0))
        self.kind = kind[np.clip(at[1:] - 1, 0, len(kind) - 1)]
        self.T, self.t = np.diff(state.t[at]), state.t[at]
        # a second of driving each, less if wheels hardly turn; standstills do not count
        rolled = np.abs(np.diff(s)).max(axis=0)
        self.share = np.clip(rolled, 0.02 * np.minimum(self.T, 1.0), self.T)
        stamp = stamp_of(self.t, state.constants)
        for begin, end in _unknown(problem.leg):
            self.share[(stamp[1:] > begin) & (stamp[:-1] < end)] = DOUBTED
        self.scale = state.scale
        self.steer = {i: self._steering(state, up, i) for i, fixed in enumerate(self.fixed)
                      if not fixed}

    def _left(self, i: int, width: float) -> float:
        """Return the prior place of a wheel: axles are left, right; an odd last one between."""
        alone = i == len(self.leg.wheels) - 1 and i % 2 == 0
        return 0.0 if alone else (width or TRACK_WIDTH.of_a_car) / 2 * (1 if i % 2 == 0 else -1)

    def _steering(self, state: layout.State, up: Floats, i: int) -> Floats:
        """Return the path of a steered wheel beyond a fixed one by its squared distance, 1/m."""
        leg, scale = self.leg, state.scale
        t = np.arange(self.t[0], self.t[-1], STEER_GRID)
        turn = integral_at(t, leg.t_imu, by_row(
            lambda w_b: (w_b - state.gyro_bias.mean(axis=0)) @ up, leg.w_b))
        wheels = [wheel for wheel in leg.wheels if not wheel.ahead]
        s = np.mean([as_rolled(wheel, state.constants)(t) for wheel in wheels], axis=0)
        path = steering_path(t, turn, scale * s, scale * leg.wheels[i].ahead, self._left(i, 0.0))
        return np.diff(np.interp(self.t, t, path))

    def line(self, i: int, delay: float, drift: float, width: float) -> Line:
        """Return the line: a - 1, a y, own and common delay, drift; a x^2 if it steers."""
        y0 = self._left(i, width)
        X = np.stack([self.path, -self.turn, self.faster, y0 * self.turning, y0 * self.T], -1)
        taped = TRACK_WIDTH.taped_share * width / 2
        prior = np.array([1.0, taped or TRACK_WIDTH.any_sigma, OWN_DELAY,
                          max(delay, 1e-4), max(drift, 1e-9)])
        centre = np.array([0.0, y0 if taped else 0.0, 0.0, 0.0, 0.0])
        if i in self.steer:
            X = np.column_stack([X, self.steer[i]])
            prior, centre = np.append(prior, WHEELBASE**2), np.append(centre, 0.0)
        weight = np.where(self.fixed, -1 / self.fixed.sum(), 0.0)
        weight[i] += 1.0
        rounding = sum((w * q.quantum * self.scale)**2 / 12 for w, q in zip(
            weight, self.leg.wheels, strict=True))
        return fit_line(Increments(
            np.diff(self.s[i] - self.mean), X, prior, centre,
            max(float(rounding), 1e-4**2), self.share, self.kind, np.full(3, FIRST_WALK)))

    def moved(self, i: int, line: Line) -> Floats:
        """Return the derivatives of a - 1, a y and a x^2 by ln K and the gyro's errors."""
        rows = [0, 1, *range(NUISANCE.stop, len(line.x))]
        by_scale, by_gyro = [0.0, line.x[1]], -line.gain[rows] @ self.turn_errors * line.x[1]
        if i in self.steer:     # q is proportional to the squared turn over the path
            by_scale.append(2 * line.x[-1])
            curvature = self.turn / np.where(self.path, self.path, np.inf)
            by_gyro += line.gain[rows] @ (curvature[:, None] * self.turn_errors) * line.x[-1]
        return np.column_stack([by_scale, by_gyro])


def _wheel(line: Line, moved: Floats, of_fit: Floats) -> Wheel:
    rows = [k for k in range(len(line.x)) if k not in NUISANCE]
    a, y = 1 + line.x[0], line.x[1] / (1 + line.x[0])
    covariance = line.covariance[np.ix_(rows, rows)] + moved @ of_fit @ moved.T
    gradient = np.array([-y, 1.0]) / a
    whole = Wheel(float(1 / a), float(np.sqrt(covariance[0, 0]) / a), float(y),
                  float(np.sqrt(gradient @ covariance[:2, :2] @ gradient)),
                  tuple(np.sqrt(line.levels).tolist()))
    if len(rows) == 2:
        return whole
    x = float(np.sqrt(max(line.x[-1], 0.0) / a))
    sigma = float(np.sqrt(covariance[2, 2])) / (2 * a * max(x, 0.1))
    return replace(whole, x=x, x_sigma=float(np.hypot(sigma, PLACE_SHARE * x)))


def fit_line(seen: Increments) -> Line:
    """Return the line at the maximum of the restricted likelihood, with down-weighted outliers."""
    from scipy.optimize import minimize
    spread = np.ones(len(seen.y))
    log_levels = np.zeros(len(seen.walk) + 1)
    for _ in range(TAIL_ROUNDS):
        simplex = log_levels + np.concatenate([np.zeros((1, len(log_levels))), -2 * np.eye(
            len(log_levels))])
        found = minimize(_minus_log_likelihood, log_levels, args=(seen, spread),
                         method='Nelder-Mead', options={
                             'xatol': 0.05, 'fatol': 0.02, 'initial_simplex': simplex})
        log_levels = found.x
        x, covariance, _, banded, root = _solved(log_levels, seen, spread)
        off = _left_out(banded, root, seen.y - seen.X @ x)
        before, spread = spread, np.maximum(spread * (off / TAIL_SIGMAS)**2, 1.0)
        if np.allclose(spread, before, rtol=TAIL_SETTLED):
            break
    gain = covariance @ cho_solve_banded((root, False), seen.X, check_finite=False).T
    return Line(x, covariance, seen.walk * np.exp(log_levels[:-1]), gain)


def _solved(log_levels: Floats, seen: Increments,
            spread: Floats) -> tuple[Floats, Floats, float, Floats, Floats]:
    """Return x, its covariance, -2 log likelihood, increments' covariance and root (banded)."""
    reading = seen.reading * np.exp(log_levels[-1])
    walk = (seen.walk * np.exp(log_levels[:-1]))[seen.kind] * seen.share * spread
    banded = np.empty((2, len(seen.y)))
    banded[0], banded[1] = -reading, walk + 2 * reading
    root = cholesky_banded(banded, check_finite=False)
    both = np.column_stack([seen.X, seen.y - seen.X @ seen.centre])
    inverse = both.T @ cho_solve_banded((root, False), both, check_finite=False)
    information = inverse[:-1, :-1] + np.diag(1 / seen.prior**2)
    covariance = np.linalg.inv(information)
    step = covariance @ inverse[:-1, -1]
    cost = (2 * np.log(root[1]).sum() + np.linalg.slogdet(information)[1] + inverse[-1, -1]
            - step @ information @ step)
    return seen.centre + step, covariance, float(cost), banded, root


def _minus_log_likelihood(log_levels: Floats, seen: Increments, spread: Floats) -> float:
    walk, reading = log_levels[:-1], log_levels[-1]
    held = (walk.mean()**2 / WALK_SPREAD**2 + ((walk - walk.mean())**2).sum() / APART_SPREAD**2
            + reading**2 / READING_SPREAD**2)
    return (_solved(log_levels, seen, spread)[2] + float(held)) / 2


def _left_out(banded: Floats, root: Floats, residual: Floats) -> Floats:
    """Return leave-one-out residuals of the increments, in sigmas: (k,)."""
    weighted = cho_solve_banded((root, False), residual, check_finite=False)
    before, after = banded[1].copy(), banded[1].copy()
    square, k = banded[0, -1]**2, len(residual)
    for i in range(1, k):
        before[i] -= square / before[i - 1]
        after[k - 1 - i] -= square / after[k - i]
    off: Floats = weighted * np.sqrt(before + after - banded[1])
    return off
