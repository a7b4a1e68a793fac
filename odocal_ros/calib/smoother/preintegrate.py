# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Preintegration: dR, dv, dp and S of each interval, docs/method.md (S4).

All in the body frame at the interval's begin, so that nothing depends on where the vehicle is:
with R the attitude since then, dv, dp the single and double integral of R f, S the sum of R over
travel (Forster et al. 2017 have the first two). Errors of the IMU are constant within a step:
they turn R by -A d within it, A the integral of R, and shift the force by as much. No loop over
steps: rotations by a prefix product, the rest by cumulative sums, some intervals at a time.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.smoother.imu_steps import ImuSteps
from odocal_ros.calib.smoother.state import (
    ACCEL,
    ACCEL_AXIS,
    ACCEL_SIGNAL,
    GYRO,
    GYRO_AXIS,
    GYRO_SIGNAL,
)
from odocal_ros.data.arrays import Ints
from odocal_ros.data.mapped import let_go
from odocal_ros.nav.rotations import (
    exp_so3,
    matrix_from_quat,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    skew,
)
from odocal_ros.nav.strapdown import prefix_product

Floats = NDArray[np.float64]
# judgement: steps whose arrays stay in the cache; with 256, a pass takes twice the time
STEPS_AT_A_TIME = 2048


@dataclass(frozen=True, eq=False)
class Intervals:
    """Sums over K intervals of length T, s; (K, ...) in the body frame at each begin."""

    T: Floats        # (K,)
    R: Floats        # (K, 3, 3) attitude at the end
    dv: Floats       # (K, 3) m/s
    dp: Floats       # (K, 3) m
    A: Floats        # (K, 3, 3) integral of R, s: d dv = -A d ba
    AA: Floats       # (K, 3, 3) its integral: d dp = -AA d ba
    F: Floats        # (K, 3, a) integral of R's columns ACCEL_AXIS times the forces ACCEL_SIGNAL
    #                  as measured: d dv = -F d constants; not A times the mean force, which may be
    #                  millimetres off and would tell a scale that nothing tells
    FF: Floats       # (K, 3, a) its integral: d dp = -FF d constants
    # by the gyro bias (3) and by the constants of GYRO (g)
    turned: Floats   # (K, 3, 3 + g) the end turns by -turned d; the first three are A
    dv_by: Floats    # (K, 3, 3 + g) derivative of dv
    dp_by: Floats    # (K, 3, 3 + g)
    S: Floats        # (K, 3, 3) sum of R over travel, scale units
    S_by: Floats     # (K, 3, 3 + g) derivative of S @ forward
    mean_rate: Floats   # (K, 3) mean turn rate as measured, bias and all, rad/s
    mean_force: Floats  # (K, 3) mean specific force as measured, m/s^2
    longest_step: Floats   # (K,) longest gap between Imu rows, s

    def take(self, rows: slice) -> 'Intervals':
        """Return the intervals of a slice."""
        return Intervals(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Points:
    """Sums from the begin of an interval to m times within it."""

    interval: NDArray[np.int64]   # (m,)
    tau: Floats      # (m,) s since the begin
    dv: Floats       # (m, 3)
    dp: Floats       # (m, 3)
    R: Floats        # (m, 3, 3)
    AA: Floats       # (m, 3, 3)
    F: Floats        # (m, 3, a)
    FF: Floats       # (m, 3, a)
    force: Floats    # (m, 3) m/s^2, specific force, in the body frame at the begin
    rate: Floats     # (m, 3) rad/s, turn rate, in the body frame at the time
    spin: Floats     # (m, 3) rad/s^2, by which that rises

    def take(self, index: Ints) -> 'Points':
        """Return the points that an index picks."""
        return Points(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


Some = TypeVar('Some', Intervals, Points)


def turn(C: Floats, vectors: Floats) -> Floats:
    """Return C @ v row by row: (K, 3, 3), (K, 3)."""
    out: Floats = np.einsum('kij,kj->ki', C, vectors)
    return out


def preintegrate(imu: ImuSteps, gyro_bias: Floats, accel_bias: Floats,
                 travel: Callable[[Floats], Floats], forward: Floats, t_points: Floats,
                 constants: Floats | None = None) -> tuple[Intervals, Points]:
    """
    Sum up all intervals.

    imu : steps.   gyro_bias, accel_bias : (K, 3) taken out, one for each interval.   travel : (m,)
    times, s, to travel, scale units.   forward : (3,) scale times forward axis, for S_by.
    t_points : (m,) times of fixes, rising, within the keyframes.   constants : (M,) of which GYRO
    and ACCEL are taken out.

    Returns
    -------
    Intervals, Points.

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
        out.append(part.intervals(travel, forward))
        points.append(part.points(t_points[mine], owner[mine] - first, first))
        let_go()
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


def _gyro(x: Floats) -> Floats:
    """Return what bias and constants of the gyro do, from (n, 3, 3, 6): (n, 3, 3 + g)."""
    out: Floats = x[:, :, [0, 1, 2, *GYRO_AXIS], [0, 0, 0, *np.add(GYRO_SIGNAL, 1)]]
    return out


def _accel(x: Floats) -> tuple[Floats, Floats]:
    """Return what bias and constants of the accelerometer do, from (n, 3, 3, 4)."""
    return x[:, :, :, 0], x[:, :, ACCEL_AXIS, np.add(ACCEL_SIGNAL, 1)]


class _Chunk:
    """Some intervals at once: sums from each interval's begin up to every step."""

    def __init__(self, imu: ImuSteps, first: int, last: int, gyro_bias: Floats,
                 accel_bias: Floats, constants: Floats | None) -> None:
        key = imu.key[first:last + 1]
        rows = slice(key[0], key[-1])
        self.t, self.key = imu.t[key[0]:key[-1] + 1], key - key[0]
        self.own = np.repeat(np.arange(len(key) - 1), np.diff(key))     # interval of each step
        self.dt = np.diff(self.t)
        self.signals, self.longest = imu.signals[rows], imu.longest[rows]
        dt = self.dt[:, None]
        gyro, accel = self._errors(gyro_bias, accel_bias, constants)
        self.turn, self.turn_mean = imu.turn[rows] - gyro, imu.turn_mean[rows] - gyro / 2
        square = skew(self.turn) @ skew(self.turn)
        # integral of the attitude over a step of unit length, and the integral of that
        self.G = np.eye(3) + skew(self.turn_mean) + square / 6
        self.GG = np.eye(3) / 2 + skew(self.turn_mean / 2 - self.turn / 12) + square / 24
        q = quat_multiply(quat_from_rotvec(-turn(self.G, gyro)), quat_from_rotvec(imu.turn[rows]))
        q = prefix_product(np.concatenate([[[0.0, 0.0, 0.0, 1.0]], q]))
        back = quat_conjugate(q[self.key[:-1]])[self.own]
        self.R = matrix_from_quat(quat_multiply(back, q[:-1]))
        self.R_end = matrix_from_quat(quat_multiply(back[self.key[1:] - 1], q[self.key[1:]]))
        # a turn that grows over the step acts on the force's moment about its begin
        self.grows = np.eye(3) + skew(self.turn) / 3
        dv, dp, turned = imu.dv[rows], imu.dp[rows], turn(self.grows, gyro)
        dv, dp = (dv - np.cross(turned, dv - dp / dt) - turn(self.G, accel),
                  dp - np.cross(turned, dv * dt / 6) - turn(self.GG, accel) * dt)
        self.step_v, self.step_p = turn(self.R, dv), turn(self.R, dp)
        self.v, self.dv = self._running(self.step_v)
        self.p, self.dp = self._running(self.v * dt + self.step_p)
        # integrals of R over a step, single and double
        self.mean, self.twice = self.R @ self.G, self.R @ self.GG * dt[:, None]
        # what biases and constants of gyro and accelerometer multiply
        self.by_gyro, self.by_accel = (np.concatenate([dt, self.signals[:, columns]], axis=1)
                                       for columns in (slice(5), slice(3, 6)))
        self.since = self.t[:-1] - self.t[self.key[:-1]][self.own]      # s, begin of the interval

    def _errors(self, gyro_bias: Floats, accel_bias: Floats,
                constants: Floats | None) -> tuple[Floats, Floats]:
        """Return what the errors add up to in a step: (n, 3) rad, (n, 3) m/s, method (S3)."""
        gyro, accel = (bias[self.own] * self.dt[:, None] for bias in (gyro_bias, accel_bias))
        if constants is not None:
            by_gyro, by_accel = np.zeros((3, 6)), np.zeros((3, 3))
            by_gyro[GYRO_AXIS, GYRO_SIGNAL] = constants[GYRO]
            by_accel[ACCEL_AXIS, ACCEL_SIGNAL] = constants[ACCEL]
            gyro = gyro + self.signals @ by_gyro.T
            accel = accel + self.signals[:, 3:] @ by_accel.T
        return gyro, accel

    def _running(self, step: Floats) -> tuple[Floats, Floats]:
        """Return the sum before each step since the interval's begin, and each interval's sum."""
        total = np.cumsum(step, axis=0)
        before = total - step
        start = before[self.key[:-1]]
        return before - start[self.own], total[self.key[1:] - 1] - start

    def _sum(self, step: Floats) -> Floats:
        """Return the sum of each interval."""
        return np.add.reduceat(step, self.key[:-1])

    def intervals(self, travel: Callable[[Floats], Floats], forward: Floats) -> Intervals:
        """
        Return the sums of each interval.

        An error in a step acts on what follows it in the interval: a turn on the rest of dv, dp
        and S, a force for the rest of the time.
        """
        T, dt, ds = np.diff(self.t[self.key]), self.dt[:, None], np.diff(travel(self.t))[:, None]
        rest = T[self.own, None] - self.since[:, None] - dt
        v, way = self.v + self.step_v, self.mean * ds[:, :, None]
        walked, walk = self._running(way @ forward)
        dv_rest = self.dv[self.own] - v
        dp_rest = self.dp[self.own] - self.p - self.v * dt - self.step_p - v * rest
        S_rest = walk[self.own] - walked - way @ forward
        grown, moment = self.R @ self.grows, self.step_v - self.step_p / dt
        cross, ahead = skew(self.turn), skew(forward)
        own = ahead / 2 + (cross @ ahead + skew(np.cross(self.turn, forward))) / 6
        by_turn = (self.mean, _cross(dv_rest, self.mean) + _cross(moment, grown),
                   _cross(dp_rest, self.mean)
                   + _cross(moment * rest + self.step_v * (dt / 6), grown),
                   _cross(S_rest, self.mean) + self.R @ own * ds[:, :, None])
        turned, dv_by, dp_by, S_by = (_gyro(self._sum(_by(step, self.by_gyro)))
                                      for step in by_turn)
        by_force = (self.mean, self.mean * rest[:, :, None] + self.twice)
        (A, F), (AA, FF) = (_accel(self._sum(_by(step, self.by_accel))) for step in by_force)
        measured = self._sum(self.signals) / T[:, None]
        return Intervals(T, self.R_end, self.dv, self.dp, A, AA, F, FF, turned, dv_by, dp_by,
                         self._sum(way), S_by, measured[:, :3], measured[:, 3:],
                         np.maximum.reduceat(self.longest, self.key[:-1]))

    def points(self, t: Floats, interval: Ints, first: int) -> Points:
        """Return the sums to times in given intervals: rate and force change evenly in a step."""
        j = np.clip(np.searchsorted(self.t, t, side='right') - 1, self.key[interval],
                    self.key[interval + 1] - 1)
        h, dt = (t - self.t[j])[:, None], self.dt[j, None]
        rise = (6 * self.step_v[j] - 12 * self.step_p[j] / dt) / dt**2
        force = self.step_v[j] / dt - rise * dt / 2
        dv = self.v[j] + force * h + rise * h**2 / 2
        dp = self.p[j] + self.v[j] * h + force * h**2 / 2 + rise * h**3 / 6
        spin = 6 * (self.turn[j] - 2 * self.turn_mean[j]) / dt**2
        rate = self.turn[j] / dt - spin * dt / 2
        R = self.R[j] @ exp_so3(rate * h + spin * h**2 / 2)
        # those of the steps before, and of the step
        begin, share = self.key[interval], (h / dt)[:, None]
        tau = (self.since[j, None] + h)[:, :, None, None]

        def before(step: Floats) -> Floats:
            step = _by(step, self.by_accel)
            total = np.cumsum(step, axis=0) - step
            out: Floats = total[j] - total[begin]
            return out

        single, by = before(self.mean), self.by_accel[j]
        _, F = _accel(single + _by(self.mean[j] * share, by))
        AA, FF = _accel(single * tau + _by(self.twice[j] * share**2, by) + before(
            self.twice - self.mean * (self.since + self.dt)[:, None, None]))
        return Points(interval + first, t - self.t[self.key[interval]], dv, dp, R, AA,
                      F, FF, force + rise * h, rate + spin * h, spin)
