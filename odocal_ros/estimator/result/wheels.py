# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Factor and position of each wheel relative to the mean, docs/method.md (W1) to (W4).

The scale factor of the fit applies to the mean reading of the wheels that do not steer. The
reading of a wheel differs from the mean by the turn times the wheel's distance from the middle,
and by the difference of the tyres; a steered wheel also rolls farther in turns, (W9):

    K (s_i - s) = (a_i - 1) K s - a_i y_i psi + a_i x_i^2 q,        K_i = K / a_i

s_i and s the readings of wheel i and of the mean, psi the turn, y_i the wheel's place, positive to
the left, x_i its distance ahead. The turn is from the attitudes of the fit; each wheel has one
line. The positions include the effect of load in turns: the outer tyre has a higher load and a
smaller rolling radius.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.pieces import by_row
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.interval_noise import hard_and_turning
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.odometer_filter import as_rolled, stamp_of
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.wheel_noise import fit_line, Increments, Line
from odocal_ros.nav.integral import integral_at
from odocal_ros.nav.rotations import rotvec
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


@dataclass(frozen=True, eq=False)
class Wheel:
    """A wheel relative to the mean."""

    ratio: float             # K_i / K
    ratio_sigma: float       # relative
    y: float                 # m to the left of the middle of all wheels
    y_sigma: float           # m
    walk: tuple[float, ...]  # m/sqrt(s), relative to the mean: even, hard, in turns
    x: float | None = None   # m, of a steered wheel ahead of the mean; None: it does not steer
    x_sigma: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of calibration.json."""
        return {key: value for key, value in asdict(self).items() if value is not None}


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
    for t in leg.doubt_t:
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
        self.turn = np.diff(np.append(0.0, np.cumsum(turn))[at])
        signals = np.concatenate([motion.sums.mean_rate, motion.sums.mean_force], axis=1)
        errors = signals[:, layout.GYRO_SIGNAL] * up[list(layout.GYRO_AXIS)] * motion.T
        ends = np.concatenate([np.zeros((1, errors.shape[1])), np.cumsum(errors, axis=0)])
        self.turn_errors = np.diff(ends[at], axis=0)     # by units of the gyro's errors
        rate = (problem.rate_b - state.gyro_bias) @ up
        speed = np.einsum('ki,ki->k', state.v_n, state.C_nb @ state.forward)
        self.faster, self.turning = np.diff(speed[at]), np.diff(rate[at])
        hard, turns = hard_and_turning(motion)
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
