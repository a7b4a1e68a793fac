# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Preintegration: dR, dv, dp and S of each interval, and up to times within it, docs/method.md (S4).

All values are in the body frame at the start of the interval, independent of the position of the
vehicle. R is the attitude since then, dv and dp the single and double integral of R f, S the sum
of R over travel (dR, dv, dp: Forster et al. 2017). IMU errors d are constant within a step: they
rotate R by -A d, with A the integral of R, and change the force accordingly. There is no loop over
steps: rotations are prefix products, the other values cumulative sums, in chunks of intervals.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, release_mapped_memory
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.imu import ImuSteps
from odocal_ros.nav.rotations import (
    exp_so3,
    matrix_from_quat,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    rotate,
    skew,
)
from odocal_ros.nav.strapdown import prefix_product

# judgement: steps whose arrays stay in the cache; with 256, a pass takes twice the time
STEPS_AT_A_TIME = 2048
# definition: signals of a step that the errors of gyro and accelerometer multiply, of (1, w, f, f
# with its bias): the g-sensitivity of the gyro has the latter, so that b_a does not turn
OF_GYRO, OF_ACCEL = np.array([0, 1, 2, 3, 7, 8]), np.array([0, 4, 5, 6])


@dataclass(frozen=True, eq=False)
class Intervals:
    """Sums over K intervals of length T, s; (K, ...) in the body frame at each begin."""

    T: Floats        # (K,)
    R: Floats        # (K, 3, 3) attitude at the end
    dv: Floats       # (K, 3) m/s
    dp: Floats       # (K, 3) m
    A: Floats        # (K, 3, 3) integral of R (1 - M_a), s: d dv = -A d ba
    AA: Floats       # (K, 3, 3) its integral: d dp = -AA d ba
    F: Floats        # (K, 3, a) integral of R's columns ACCEL_AXIS times the forces ACCEL_SIGNAL
    #                  less their biases: d dv = -F d constants; A times the mean force may be
    #                  millimetres off, which would determine a scale that is not observable
    FF: Floats       # (K, 3, a) its integral: d dp = -FF d constants
    # by the gyro bias (3) and by the constants of GYRO (g)
    R_by_gyro: Floats     # (K, 3, 3 + g) an error d of them turns the end by -R_by_gyro d
    dv_by_gyro: Floats    # (K, 3, 3 + g) derivative of dv
    dp_by_gyro: Floats    # (K, 3, 3 + g)
    S: Floats        # (K, 3, 3) sum of R over travel, scale units
    S_by_gyro: Floats     # (K, 3, 3 + g) derivative of S @ forward
    mean_rate: Floats   # (K, 3) mean measured turn rate less its bias, rad/s
    mean_force: Floats  # (K, 3) mean measured specific force less its bias, m/s^2
    longest_step: Floats   # (K,) longest gap between IMU rows, s

    def take(self, rows: slice) -> 'Intervals':
        """Return the intervals of a slice."""
        return Intervals(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Points:
    """Sums from the begin of an interval to m times within it."""

    interval: Ints   # (m,)
    tau: Floats      # (m,) s since the begin
    dv: Floats       # (m, 3)
    dp: Floats       # (m, 3)
    R: Floats        # (m, 3, 3)
    A: Floats        # (m, 3, 3)
    AA: Floats       # (m, 3, 3)
    F: Floats        # (m, 3, a)
    FF: Floats       # (m, 3, a)
    R_by_gyro: Floats     # (m, 3, 3 + g)
    dv_by_gyro: Floats    # (m, 3, 3 + g)
    dp_by_gyro: Floats    # (m, 3, 3 + g)
    force: Floats    # (m, 3) m/s^2, specific force, in the body frame at the begin
    rate: Floats     # (m, 3) rad/s, turn rate, in the body frame at the time
    spin: Floats     # (m, 3) rad/s^2, its rate of change
    measured: Floats    # (m, 6) turn rate and specific force less their biases, means of the step

    def take(self, index: Ints) -> 'Points':
        """Return the points selected by an index."""
        return Points(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


Some = TypeVar('Some', Intervals, Points)


def preintegrate(imu: ImuSteps, gyro_bias: Floats, accel_bias: Floats,
                 travel: Callable[[Floats], Floats], forward: Floats, t_points: Floats,
                 constants: Floats | None = None) -> tuple[Intervals, Points]:
    """
    Return the sums over all intervals, and up to points within them.

    imu : steps.   gyro_bias, accel_bias : (K, 3) taken out, one for each interval.   travel : (m,)
    times, s, to travel, scale units.   forward : (3,) scale times forward axis, for S_by_gyro.
    t_points : (m,) times of fixes, rising, within the keyframes.   constants : (M,) of which GYRO
    and ACCEL are taken out.
    """
    out: list[Intervals] = []
    points: list[Points] = []
    t, K = imu.t, len(imu.key) - 1
    owner = np.clip(np.searchsorted(t[imu.key], t_points, side='right') - 1, 0, K - 1)
    per = max(1, int(STEPS_AT_A_TIME * K / len(t)))
    for first in range(0, K, per):
        last = min(first + per, K)
        mine = slice(np.searchsorted(owner, first), np.searchsorted(owner, last))
        part = _Chunk(imu, first, last, gyro_bias[first:last], accel_bias[first:last], constants)
        steps = part.steps_of(t_points[mine], owner[mine] - first)
        part.cut(steps)
        out.append(part.intervals(travel, forward))
        points.append(part.points(t_points[mine], steps, owner[mine] - first, first))
        release_mapped_memory()
    return _joined(Intervals, out), _joined(Points, points)


def _joined(cls: type[Some], parts: list[Some]) -> Some:
    if len(parts) == 1:
        return parts[0]
    return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts])
                  for f in fields(cls)})


def _cross(a: Floats, M: Floats) -> Floats:
    """Return [a x] M: (n, 3), (n, 3, 3)."""
    x, y, z = (a[:, i, None] for i in range(3))
    out = np.empty_like(M)
    out[:, 0] = y * M[:, 2] - z * M[:, 1]
    out[:, 1] = z * M[:, 0] - x * M[:, 2]
    out[:, 2] = x * M[:, 1] - y * M[:, 0]
    return out


def _by(step: Floats, signals: Floats) -> Floats:
    """Return the columns of (n, 3, 3) times each of signals (n, s): (n, 3, 3, s)."""
    return step[:, :, :, None] * signals[:, None, None, :]


class _Chunk:
    """Some intervals at once: sums from each interval's begin up to every step."""

    def __init__(self, imu: ImuSteps, first: int, last: int, gyro_bias: Floats,
                 accel_bias: Floats, constants: Floats | None) -> None:
        key = imu.key[first:last + 1]
        rows = slice(key[0], key[-1])
        self.t, self.key = imu.t[key[0]:key[-1] + 1], key - key[0]
        self.own = np.repeat(np.arange(len(key) - 1), np.diff(key))     # interval of each step
        self.dt = np.diff(self.t)
        self.longest, dt = imu.longest[rows], self.dt[:, None]
        biases = np.concatenate([gyro_bias, accel_bias], axis=1)[self.own] * dt
        # signals that biases and constants of gyro and accelerometer multiply
        self.signals = np.concatenate([dt, imu.signals[rows] - biases, imu.signals[rows, 3:5]],
                                      axis=1)
        # shares of the signals that are errors, docs/method.md (S3)
        self.by_gyro, self.by_accel = np.zeros((3, 5)), np.zeros((3, 3))
        if constants is not None:
            self.by_gyro[layout.GYRO_AXIS, layout.GYRO_SIGNAL] = constants[layout.GYRO]
            self.by_accel[layout.ACCEL_AXIS, layout.ACCEL_SIGNAL] = constants[layout.ACCEL]
        gyro = biases[:, :3] + self.signals[:, OF_GYRO[1:]] @ self.by_gyro.T
        accel = biases[:, 3:] + self.signals[:, OF_ACCEL[1:]] @ self.by_accel.T
        self.turn, self.turn_mean = imu.turn[rows] - gyro, imu.turn_mean[rows] - gyro / 2
        square = skew(self.turn) @ skew(self.turn)
        # integral of the attitude over a step of unit length, and the integral of that
        self.G = np.eye(3) + skew(self.turn_mean) + square / 6
        self.GG = np.eye(3) / 2 + skew(self.turn_mean / 2 - self.turn / 12) + square / 24
        q = quat_multiply(quat_from_rotvec(-rotate(self.G, gyro)),
                          quat_from_rotvec(imu.turn[rows]))
        q = prefix_product(np.concatenate([[[0.0, 0.0, 0.0, 1.0]], q]))
        back = quat_conjugate(q[self.key[:-1]])[self.own]
        self.R = matrix_from_quat(quat_multiply(back, q[:-1]))
        self.R_end = matrix_from_quat(quat_multiply(back[self.key[1:] - 1], q[self.key[1:]]))
        # a rotation that grows over the step multiplies the force times the time since its start
        self.grows = np.eye(3) + skew(self.turn) / 3
        dv, dp, turned = imu.dv[rows], imu.dp[rows], rotate(self.grows, gyro)
        dv, dp = (dv - np.cross(turned, dv - dp / dt) - rotate(self.G, accel),
                  dp - np.cross(turned, dv * dt / 6) - rotate(self.GG, accel) * dt)
        self.step_v, self.step_p = rotate(self.R, dv), rotate(self.R, dp)
        self.v, self.dv = self._running(self.step_v)
        self.p, self.dp = self._running(self.v * dt + self.step_p)
        # integrals of R over a step, single and double
        self.mean, self.twice = self.R @ self.G, self.R @ self.GG * dt[:, None]
        self.since = self.t[:-1] - self.t[self.key[:-1]][self.own]      # s, begin of the interval

    def _gyro(self, x: Floats) -> Floats:
        """Return the effects of a gyro's bias and constants, (n, 3, 3 + g), from (n, 3, 3, 6)."""
        signals = [0, 0, 0, *np.add(layout.GYRO_SIGNAL, 1)]
        out: Floats = x[:, :, [0, 1, 2, *layout.GYRO_AXIS], signals]
        out[:, :, :3] = out[:, :, :3] @ (np.eye(3) - self.by_gyro[:, :3])
        return out

    def _accel(self, x: Floats) -> tuple[Floats, Floats]:
        """Return the effects of bias and constants of the accelerometer, from (n, 3, 3, 4)."""
        return (x[:, :, :, 0] @ (np.eye(3) - self.by_accel),
                x[:, :, layout.ACCEL_AXIS, np.add(layout.ACCEL_SIGNAL, 1)])

    def _running(self, step: Floats) -> tuple[Floats, Floats]:
        """Return the sum before each step since the interval's begin, and each interval's sum."""
        total = np.cumsum(step, axis=0)
        before = total - step
        start = before[self.key[:-1]]
        return before - start[self.own], total[self.key[1:] - 1] - start

    def _sum(self, step: Floats) -> Floats:
        """Return the sum of each interval."""
        return np.add.reduceat(step, self.key[:-1])

    def steps_of(self, t: Floats, interval: Ints) -> Ints:
        """Return the step that each time lies in."""
        return np.clip(np.searchsorted(self.t, t, side='right') - 1, self.key[interval],
                       self.key[interval + 1] - 1)

    def cut(self, steps: Ints) -> None:
        """
        Sum the effects of errors in each step, from the interval start to its end and to steps.

        An error in a step acts on the rest of the interval: a rotation on the rest of dv and dp, a
        force for the remaining time. Terms that depend on the end are factors of the sums
        (``_effects``).
        """
        self.cuts = np.unique(np.concatenate([self.key[:-1], steps]))
        dt, by = self.dt[:, None], self.signals
        end, v, p = self.since[:, None] + dt, self.v + self.step_v, self.p + self.v * dt
        moment, grown = self.step_v - self.step_p / dt, self.R @ self.grows
        self.sums = [self._before(*one) for one in (
            (self.mean, by),
            (_cross(v, self.mean) - _cross(moment, grown), by[:, OF_GYRO]),
            (_cross(p + self.step_p - v * end, self.mean)
             + _cross(moment * end - self.step_v * (dt / 6), grown), by[:, OF_GYRO]),
            (self.twice - self.mean * end[:, :, None], by[:, OF_ACCEL]))]

    def _before(self, step: Floats, signals: Floats) -> Floats:
        """Return the sums of (n, 3, 3) times signals (n, s) before each cut and up to the last."""
        out = np.zeros((len(self.cuts) + 1, 3, 3, signals.shape[1]))
        np.add.reduceat(_by(step, signals), self.cuts, out=out[1:])
        return np.cumsum(out, axis=0, out=out)

    def _effects(self, begin: Ints, end: Ints, dv: Floats, dp: Floats,
                 tau: Floats) -> tuple[Floats, ...]:
        """Return A to FF and the derivatives by the gyro, of errors in steps between (m,) cuts."""
        first, last = (np.searchsorted(self.cuts, x) for x in (begin, end))
        turns, once, twice, late = (x[last] - x[first] for x in self.sums)
        by_turn = self._gyro(turns[..., OF_GYRO])
        once, force = self._gyro(once), turns[..., OF_ACCEL]
        (A, F), (AA, FF) = self._accel(force), self._accel(force * tau[..., None] + late)
        return (A, AA, F, FF, by_turn, _cross(dv, by_turn) - once,
                _cross(dp, by_turn) - once * tau - self._gyro(twice))

    def intervals(self, travel: Callable[[Floats], Floats], forward: Floats) -> Intervals:
        """Return the sums of each interval."""
        T, ds = np.diff(self.t[self.key]), np.diff(travel(self.t))[:, None]
        moved = self.mean * ds[:, :, None]
        walked, walk = self._running(moved @ forward)
        S_rest = walk[self.own] - walked - moved @ forward
        cross, ahead = skew(self.turn), skew(forward)
        own = ahead / 2 + (cross @ ahead + skew(np.cross(self.turn, forward))) / 6
        S_by_gyro = self._sum(_by(_cross(S_rest, self.mean) + self.R @ own * ds[:, :, None],
                             self.signals[:, OF_GYRO]))
        A, AA, F, FF, R_by_gyro, dv_by_gyro, dp_by_gyro = self._effects(
            self.key[:-1], self.key[1:], self.dv, self.dp, T[:, None, None])
        measured = self._sum(self.signals[:, 1:7]) / T[:, None]
        return Intervals(T, self.R_end, self.dv, self.dp, A, AA, F, FF, R_by_gyro, dv_by_gyro,
                         dp_by_gyro, self._sum(moved), self._gyro(S_by_gyro), measured[:, :3],
                         measured[:, 3:], np.maximum.reduceat(self.longest, self.key[:-1]))

    def points(self, t: Floats, j: Ints, interval: Ints, first: int) -> Points:
        """Return the sums to times in steps j, a cut each: rate and force change evenly in it."""
        h, dt = (t - self.t[j])[:, None], self.dt[j, None]
        rise = (6 * self.step_v[j] - 12 * self.step_p[j] / dt) / dt**2
        force = self.step_v[j] / dt - rise * dt / 2
        dv = self.v[j] + force * h + rise * h**2 / 2
        dp = self.p[j] + self.v[j] * h + force * h**2 / 2 + rise * h**3 / 6
        spin = 6 * (self.turn[j] - 2 * self.turn_mean[j]) / dt**2
        rate = self.turn[j] / dt - spin * dt / 2
        R = self.R[j] @ exp_so3(rate * h + spin * h**2 / 2)
        tau = t - self.t[self.key[interval]]
        A, AA, F, FF, R_by_gyro, dv_by_gyro, dp_by_gyro = self._effects(
            self.key[interval], j, dv, dp, tau[:, None, None])
        # errors within the step itself
        share, by = (h / dt)[:, None], self.signals[j]
        own = self._gyro(_by(self.mean[j] * share, by[:, OF_GYRO]))
        moved = self.step_v[j] * (h / dt)
        by = by[:, OF_ACCEL]
        (A, F), (AA, FF) = (
            (x + y for x, y in zip(before, self._accel(_by(step, by)), strict=True))
            for before, step in (((A, F), self.mean[j] * share),
                                 ((AA, FF), self.twice[j] * share**2)))
        return Points(interval + first, tau, dv, dp, R, A, AA, F, FF, R_by_gyro + own,
                      dv_by_gyro + _cross(moved / 2, own), dp_by_gyro + _cross(moved * h / 6, own),
                      force + rise * h, rate + spin * h, spin, self.signals[j, 1:7] / dt)
