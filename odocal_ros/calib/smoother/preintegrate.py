# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Preintegration: dR, dv, dp and S of each interval, docs/method.md (S4).

All in the body frame at the interval's begin, so that nothing depends on where the vehicle is:
with R the attitude since then, dv, dp the single and double integral of R f, S the sum of R over
travel (Forster et al. 2017 have the first two). Derivatives by a constant change of the biases
follow from the same sums: a bias db turns R by -A db, A the integral of R. No loop over samples:
rotations by a prefix product, the rest by cumulative sums, a chunk of intervals at a time.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.smoother.imu_rows import ImuRows, mended, signals, SomeRows
from odocal_ros.calib.smoother.state import ACCEL_AXIS, ACCEL_SIGNAL, GYRO_AXIS, GYRO_SIGNAL
from odocal_ros.data.arrays import Ints
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

    def derived_as(self, other: 'Intervals') -> 'Intervals':
        """Return these sums with the derivatives of others."""
        return _with(self, other, 'AA', 'F', 'FF', 'turned', 'dv_by', 'dp_by', 'S_by')

    def take(self, rows: slice) -> 'Intervals':
        """Return the intervals of a slice."""
        return Intervals(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def shifted(self, gyro: Floats, accel_bias: Floats, accel: Floats) -> 'Intervals':
        """
        Return the sums for errors of the IMU that differ a little.

        gyro : (K, 3 + g) biases and constants.   accel_bias : (K, 3).   accel : (a,) constants.
        """
        return replace(
            self, R=exp_so3(-turn(self.turned, gyro)) @ self.R,
            dv=self.dv + turn(self.dv_by, gyro) - turn(self.A, accel_bias) - self.F @ accel,
            dp=self.dp + turn(self.dp_by, gyro) - turn(self.AA, accel_bias) - self.FF @ accel)


@dataclass(frozen=True, eq=False)
class Points:
    """Sums from the begin of an interval to m times within it."""

    interval: NDArray[np.int64]   # (m,)
    tau: Floats      # (m,) s since the begin
    dv: Floats       # (m, 3)
    dp: Floats       # (m, 3)
    R: Floats        # (m, 3, 3)
    F: Floats        # (m, 3, a)
    FF: Floats       # (m, 3, a)
    force: Floats    # (m, 3) m/s^2, specific force, in the body frame at the begin
    rate: Floats     # (m, 3) rad/s, turn rate, in the body frame at the time

    def derived_as(self, other: 'Points') -> 'Points':
        """Return these sums with the derivatives of others, of the same points."""
        return _with(self, other, 'F', 'FF')

    def take(self, index: Ints) -> 'Points':
        """Return the points that an index picks."""
        return Points(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


Some = TypeVar('Some', Intervals, Points)


def _with(sums: Some, other: Some, *names: str) -> Some:
    return replace(sums, **{name: getattr(other, name) for name in names})


def turn(C: Floats, vectors: Floats) -> Floats:
    """Return C @ v row by row: (K, 3, 3), (K, 3)."""
    out: Floats = np.einsum('kij,kj->ki', C, vectors)
    return out


def preintegrate(imu: ImuRows, gyro_bias: Floats, accel_bias: Floats,
                 travel: Callable[[Floats], Floats], forward: Floats, t_points: Floats,
                 constants: Floats | None = None, owner: Ints | None = None,
                 derivatives: bool = True) -> tuple[Intervals, Points]:
    """
    Sum up all intervals.

    Parameters
    ----------
    imu : ImuRows
        Samples.
    gyro_bias, accel_bias : (K, 3) arrays
        Taken out, one for each interval.
    travel : callable
        (m,) times, s, to travel, scale units.
    forward : (3,) array
        Scale times forward axis, for S_by.
    t_points : (m,) array
        Times of fixes, rising, within the keyframes.
    constants : (M,) array, optional
        Of which GYRO and ACCEL are taken out.
    owner : (m,) array, optional
        Intervals of the points, rising; default: the one that each lies in.
    derivatives : bool
        False: zeros stand in for those that cost most (AA, F, FF, turned, dv_by, dp_by, S_by).

    Returns
    -------
    Intervals, Points.

    """
    out: list[Intervals] = []
    points: list[Points] = []
    owner = owners(imu, t_points) if owner is None else owner
    for first, last, rows in imu.parts():
        mine = slice(np.searchsorted(owner, first), np.searchsorted(owner, last))
        part = _Chunk(rows, mended(rows, constants), gyro_bias[first:last],
                      accel_bias[first:last], derivatives)
        out.append(part.intervals(travel, forward))
        points.append(part.points(t_points[mine], owner[mine] - first, first))
    return _joined(Intervals, out), _joined(Points, points)


def owners(imu: ImuRows, t: Floats) -> Ints:
    """Return the intervals between keyframes in which times lie: (m,)."""
    return np.clip(np.searchsorted(imu.t[imu.key], t, side='right') - 1, 0, len(imu.key) - 2)


def _joined(cls: type[Some], parts: list[Some]) -> Some:
    if len(parts) == 1:
        return parts[0]
    return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts])
                  for f in fields(cls)})


def _mean(t: Floats, x: Floats, key: Ints) -> Floats:
    """Return the means of x (n, 3) between keyframes, by the trapezoid rule: (K, 3)."""
    step = (x[:-1] + x[1:]) * (np.diff(t) / 2)[:, None]
    return np.add.reduceat(step, key[:-1]) / np.diff(t[key])[:, None]


def _cross(a: Floats, M: Floats) -> Floats:
    """Return [a x] M: (n, 3), (n, 3, 3)."""
    x, y, z = (a[:, i, None] for i in range(3))
    out = np.empty_like(M)
    out[:, 0] = y * M[:, 2] - z * M[:, 1]
    out[:, 1] = z * M[:, 0] - x * M[:, 2]
    out[:, 2] = x * M[:, 1] - y * M[:, 0]
    return out


class _Chunk:
    """Some intervals at once: sums from each interval's begin up to every step."""

    def __init__(self, imu: SomeRows, mended: tuple[Floats, Floats], gyro_bias: Floats,
                 accel_bias: Floats, derivatives: bool) -> None:
        t, key = self.t, self.key = imu.t, imu.key
        self.f_b, self.turn = imu.f_b, imu.turn
        turn, f = mended
        self.own = np.repeat(np.arange(len(key) - 1), np.diff(key))     # interval of each step
        dt = self.dt = np.diff(t)
        q = np.empty((len(t), 4))
        q[0] = 0.0, 0.0, 0.0, 1.0
        self.rate_turn = turn - gyro_bias[self.own] * dt[:, None]
        q[1:] = quat_from_rotvec(self.rate_turn)
        q = prefix_product(q)
        back = quat_conjugate(q[key[:-1]])[self.own]
        self.Rs = matrix_from_quat(quat_multiply(back, q[:-1]))
        self.Re = matrix_from_quat(quat_multiply(back, q[1:]))
        bias = accel_bias[self.own]
        self.a_s = np.einsum('nij,nj->ni', self.Rs, f[:-1] - bias)
        self.a_e = np.einsum('nij,nj->ni', self.Re, f[1:] - bias)
        self.v, self.dv = self._sums(self.a_s, self.a_e)
        self.p, self.dp = self._twice(self.v, self.a_s, self.a_e)
        self.derivatives = derivatives
        if derivatives:
            axis, signal = list(ACCEL_AXIS), list(ACCEL_SIGNAL)
            ends = self.F_s, self.F_e = (self.Rs[:, :, axis] * self.f_b[:-1, None, signal],
                                         self.Re[:, :, axis] * self.f_b[1:, None, signal])
            self.F_before, self.F = self._sums(*ends)
            self.FF_before, self.FF = self._twice(self.F_before, *ends)

    def _widen(self, x: Floats, like: Floats) -> Floats:
        return x.reshape(-1, *(1,) * (like.ndim - 1))

    def _running(self, step: Floats) -> tuple[Floats, Floats]:
        """Return the sum before each step since the interval's begin, and each interval's sum."""
        total = np.cumsum(step, axis=0)
        before = total - step
        start = before[self.key[:-1]]
        return before - start[self.own], total[self.key[1:] - 1] - start

    def _sums(self, at_start: Floats, at_end: Floats) -> tuple[Floats, Floats]:
        return self._running((at_start + at_end) * self._widen(self.dt / 2, at_start))

    def _twice(self, before: Floats, at_start: Floats, at_end: Floats) -> tuple[Floats, Floats]:
        """Integrate once more what grows from ``before`` by rates linear over the step."""
        dt = self._widen(self.dt, at_start)
        return self._running(before * dt + (2 * at_start + at_end) * (dt**2 / 6))

    def intervals(self, travel: Callable[[Floats], Floats], forward: Floats) -> Intervals:
        """Return the sums of each interval; without derivatives zeros stand for them."""
        ds = np.diff(travel(self.t)) / 2
        _, S = self._running((self.Rs + self.Re) * self._widen(ds, self.Rs))
        T = np.diff(self.t[self.key])
        _, turn = self._running(self.turn)
        A_before, A = self._sums(self.Rs, self.Re)
        AA, F = np.zeros_like(S), np.zeros((len(T), 3, len(ACCEL_AXIS)))
        by = np.zeros((len(T), 3, 3 + len(GYRO_AXIS)))
        FF, turned, dv_by, dp_by, S_by = F, by, by, by, by
        if self.derivatives:
            F, FF = self.F, self.FF
            _, AA = self._twice(A_before, self.Rs, self.Re)
            before, step, turned = self._turned()
            after = before + step
            x_s, x_e = _cross(self.a_s, before), _cross(self.a_e, after)
            dv_before, dv_by = self._sums(x_s, x_e)
            _, dp_by = self._twice(dv_before, x_s, x_e)
            x = _cross(self.Rs @ forward, before) + _cross(self.Re @ forward, after)
            _, S_by = self._running(x * self._widen(ds, x))
        return Intervals(T, self.Re[self.key[1:] - 1], self.dv, self.dp, A, AA, F, FF, turned,
                         dv_by, dp_by, S, S_by, turn / T[:, None],
                         _mean(self.t, self.f_b, self.key),
                         np.maximum.reduceat(self.dt, self.key[:-1]))

    def _turned(self) -> tuple[Floats, Floats, Floats]:
        """Return what gyro bias and constants turn: before each step, in it, in all."""
        x = np.concatenate([np.repeat(self.dt[:, None], 3, axis=1),
                            signals(self.turn, self.f_b, self.dt)[:, GYRO_SIGNAL]], axis=1) / 2
        step = (self.Rs + self.Re)[:, :, [0, 1, 2, *GYRO_AXIS]] * x[:, None, :]
        before, total = self._running(step)
        return before, step, total

    def points(self, t: Floats, interval: Ints, first: int) -> Points:
        """Return the sums up to times within given intervals of the chunk."""
        j = np.clip(np.searchsorted(self.t, t, side='right') - 1, self.key[interval],
                    self.key[interval + 1] - 1)
        h = t - self.t[j]
        h1 = h[:, None]
        share = h / self.dt[j]
        a = self.a_s[j] + (self.a_e[j] - self.a_s[j]) * (share / 3)[:, None]
        dp = self.p[j] + self.v[j] * h1 + a * h1**2 / 2
        dv = self.v[j] + (self.a_s[j] + (self.a_e[j] - self.a_s[j]) * (share / 2)[:, None]) * h1
        R = self.Rs[j] + self.Rs[j] @ skew(self.rate_turn[j] * share[:, None])
        force = self.a_s[j] + (self.a_e[j] - self.a_s[j]) * share[:, None]
        F = FF = np.zeros((len(t), 3, len(ACCEL_AXIS)))
        if self.derivatives:
            h2, change = h[:, None, None], self.F_e[j] - self.F_s[j]
            half, third = share[:, None, None] / 2, share[:, None, None] / 3
            F = self.F_before[j] + (self.F_s[j] + change * half) * h2
            FF = self.FF_before[j] + self.F_before[j] * h2 + (
                self.F_s[j] + change * third) * h2**2 / 2
        return Points(interval + first, t - self.t[self.key[interval]], dv, dp, R, F, FF, force,
                      self.rate_turn[j] / self.dt[j, None])
