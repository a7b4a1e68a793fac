# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Preintegration: sums of the IMU steps over each interval, and up to times in it, (S4).

``preintegrate`` returns them at given biases and IMU constants, with their derivatives by these
(docs/method.md; Forster et al. 2017). All values are in the axes of b at the start of the
interval, independent of the state there. R is the rotation since then, dv and dp the single and
double integral of R f with the specific force f, S the integral of R over the odometer's travel.

IMU errors d are constant within a step: they rotate R by -A d, with A the integral of R, and turn
the force. Rotations are prefix products, the other values cumulative sums, in chunks of intervals.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, release_mapped_memory
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.imu import ImuSteps
from odocal_ros.nav import rotations
from odocal_ros.nav.rotations import exp_so3, matrix_from_quat, rotate, skew
from odocal_ros.nav.strapdown import prefix_product

STEPS_AT_A_TIME = 2048    # judgement: they stay in the cache; 256 double the time of a pass
# definition: columns of ``_Chunk.signals`` that errors of gyro and accelerometer multiply. The
# columns are 1, turn rate (3), specific force (3), x and y of the force with its bias. The last
# two are for the g-sensitivity, so that an accelerometer bias does not turn the attitude
GYRO_COLUMNS, ACCEL_COLUMNS = np.array([0, 1, 2, 3, 7, 8]), np.array([0, 4, 5, 6])


@dataclass(frozen=True, eq=False)
class _Sums:
    """Arrays with a row for each interval or point."""

    def take(self, rows: slice | Ints) -> Self:
        """Return the sums of some rows."""
        return type(self)(**{name: x[rows] for name, x in vars(self).items()})

    @classmethod
    def joined(cls, parts: list[Self]) -> Self:
        """Return the rows of all parts."""
        return cls(**{f.name: np.concatenate([getattr(x, f.name) for x in parts])
                      for f in fields(cls)})


@dataclass(frozen=True, eq=False)
class Intervals(_Sums):
    """
    Sums over K intervals, (S4), in the axes of b at their starts; g, a : constants GYRO, ACCEL.

    A derivative by an accelerometer error has the name A or F, that of dp a double letter.
    """

    T: Floats        # (K,) s, length
    R: Floats        # (K, 3, 3) attitude at the end
    dv: Floats       # (K, 3) m/s
    dp: Floats       # (K, 3) m
    A: Floats        # (K, 3, 3) s, integral of R (1 - M_a): minus the derivative of dv by the bias
    AA: Floats       # (K, 3, 3) s^2, its integral: minus the derivative of dp
    # (K, 3, a) minus the derivative of dv by ACCEL. By the force of each step: with the mean
    # force, millimetres would determine a scale that is not observable
    F: Floats
    FF: Floats       # (K, 3, a) its integral: minus the derivative of dp
    # by gyro bias and GYRO: minus the rotation of the end, and derivatives of dv, dp, S @ forward
    R_by_gyro: Floats     # (K, 3, 3 + g)
    dv_by_gyro: Floats    # (K, 3, 3 + g)
    dp_by_gyro: Floats    # (K, 3, 3 + g)
    S: Floats             # (K, 3, 3) integral of R over travel, scale units
    S_by_gyro: Floats     # (K, 3, 3 + g)
    mean_rate: Floats     # (K, 3) rad/s, measured turn rate minus its bias
    mean_force: Floats    # (K, 3) m/s^2, measured specific force minus its bias
    longest_step: Floats  # (K,) s, longest time between IMU samples


@dataclass(frozen=True, eq=False)
class Points(_Sums):
    """Sums from the start of an interval to m times in it; see ``Intervals``."""

    interval: Ints   # (m,)
    tau: Floats      # (m,) s since the start
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
    force: Floats    # (m, 3) m/s^2, specific force at the time, in the axes at the start
    rate: Floats     # (m, 3) rad/s, turn rate at the time, in the axes at this time
    rate_change: Floats    # (m, 3) rad/s^2, its rate of change
    measured: Floats    # (m, 6) turn rate and specific force minus their biases, means of the step


def preintegrate(imu: ImuSteps, gyro_bias: Floats, accel_bias: Floats,
                 travel: Callable[[Floats], Floats], forward: Floats, t_points: Floats,
                 constants: Floats | None = None) -> tuple[Intervals, Points]:
    """
    Return the sums over all intervals, and up to points within them.

    gyro_bias, accel_bias : (K, 3) of each interval, subtracted.   travel : function of times, (m,)
    s, in scale units.   forward : (3,) scale times forward axis, for S_by_gyro.   t_points : (m,)
    sorted times between the first and the last keyframe.   constants : (M,), whose errors GYRO and
    ACCEL are subtracted.
    """
    out, points, K = [], [], len(imu.keyframes) - 1
    interval = np.clip(np.searchsorted(imu.t_keyframes, t_points, side='right') - 1, 0, K - 1)
    size = max(1, int(STEPS_AT_A_TIME * K / len(imu.t)))
    for first in range(0, K, size):
        last = min(first + size, K)
        inside = slice(np.searchsorted(interval, first), np.searchsorted(interval, last))
        chunk = _Chunk(imu, first, last, gyro_bias[first:last], accel_bias[first:last], constants)
        steps = chunk.find_steps(t_points[inside], interval[inside] - first)
        chunk.sum_effects(steps)
        out.append(chunk.intervals(travel, forward))
        points.append(chunk.points(t_points[inside], steps, interval[inside] - first, first))
        release_mapped_memory()
    return Intervals.joined(out), Points.joined(points)


def _cross(a: Floats, M: Floats) -> Floats:
    """Return [a x] M: (n, 3), (n, 3, 3)."""
    return np.cross(a[:, :, None], M, axis=1)


def _times(step: Floats, signals: Floats) -> Floats:
    """Return matrices (n, 3, 3) times each of the signals (n, s): (n, 3, 3, s)."""
    return step[:, :, :, None] * signals[:, None, None, :]


class _Chunk:
    """
    Some intervals at once: sums from the start of an interval up to each of its steps.

    Of n steps, in the axes of b at the start of their interval: R, v, p : attitude, velocity and
    position at the start of the step.   step_v, step_p : single and double integral of the force
    over the step.   R_mean, R_double : the same integrals of R, over dt.   time_since_start : s.
    Of intervals: first, end : first step, and first step after the interval.   R_end, dv, dp : see
    ``Intervals``.   by_gyro, by_accel : M_g and M_a of docs/method.md (S3).
    """

    def __init__(self, imu: ImuSteps, first: int, last: int, gyro_bias: Floats,
                 accel_bias: Floats, constants: Floats | None) -> None:
        keyframes = imu.keyframes[first:last + 1]
        rows = slice(keyframes[0], keyframes[-1])
        self.t = imu.t[rows.start:rows.stop + 1]
        self.first, self.end = keyframes[:-1] - rows.start, keyframes[1:] - rows.start
        self.interval = np.repeat(np.arange(last - first), np.diff(keyframes))    # of each step
        self.dt = np.diff(self.t)
        self.longest, dt = imu.longest[rows], self.dt[:, None]
        biases = np.concatenate([gyro_bias, accel_bias], axis=1)[self.interval] * dt
        # integrals of the signals over each step, columns as in GYRO_COLUMNS
        self.signals = np.column_stack([dt, imu.signals[rows] - biases, imu.signals[rows, 3:5]])
        self.by_gyro, self.by_accel = np.zeros((3, 5)), np.zeros((3, 3))
        if constants is not None:
            self.by_gyro[layout.GYRO_AXIS, layout.GYRO_SIGNAL] = constants[layout.GYRO]
            self.by_accel[layout.ACCEL_AXIS, layout.ACCEL_SIGNAL] = constants[layout.ACCEL]
        gyro = biases[:, :3] + self.signals[:, GYRO_COLUMNS[1:]] @ self.by_gyro.T
        accel = biases[:, 3:] + self.signals[:, ACCEL_COLUMNS[1:]] @ self.by_accel.T
        self.turn, self.turn_mean = imu.turn[rows] - gyro, imu.turn_mean[rows] - gyro / 2
        square = skew(self.turn) @ skew(self.turn)
        # integral of the attitude over a step of unit length, and the integral of that
        self.G = np.eye(3) + skew(self.turn_mean) + square / 6
        self.GG = np.eye(3) / 2 + skew(self.turn_mean / 2 - self.turn / 12) + square / 24
        q = rotations.quat_multiply(rotations.quat_from_rotvec(-rotate(self.G, gyro)),
                          rotations.quat_from_rotvec(imu.turn[rows]))
        q = prefix_product(np.concatenate([[[0.0, 0.0, 0.0, 1.0]], q]))
        to_start = rotations.quat_conjugate(q[self.first])[self.interval]
        self.R = matrix_from_quat(rotations.quat_multiply(to_start, q[:-1]))
        self.R_end = matrix_from_quat(rotations.quat_multiply(to_start[self.end - 1], q[self.end]))
        # an error that rotates the step uniformly turns a force by its time since the start
        self.growth = np.eye(3) + skew(self.turn) / 3
        dv, dp, rotation = imu.dv[rows], imu.dp[rows], rotate(self.growth, gyro)
        dv, dp = (dv - np.cross(rotation, dv - dp / dt) - rotate(self.G, accel),
                  dp - np.cross(rotation, dv * dt / 6) - rotate(self.GG, accel) * dt)
        self.step_v, self.step_p = rotate(self.R, dv), rotate(self.R, dp)
        self.v, self.dv = self._running_sums(self.step_v)
        self.p, self.dp = self._running_sums(self.v * dt + self.step_p)
        self.R_mean, self.R_double = self.R @ self.G, self.R @ self.GG * dt[:, None]
        self.time_since_start = self.t[:-1] - self.t[self.first][self.interval]

    def _gyro_effects(self, x: Floats) -> Floats:
        """Return the effects of a gyro's bias and constants, (n, 3, 3 + g), from (n, 3, 3, 6)."""
        out: Floats = x[:, :, [0, 1, 2, *layout.GYRO_AXIS],
                        [0, 0, 0, *np.add(layout.GYRO_SIGNAL, 1)]]
        out[:, :, :3] = out[:, :, :3] @ (np.eye(3) - self.by_gyro[:, :3])
        return out

    def _accel_effects(self, x: Floats) -> tuple[Floats, Floats]:
        """Return the effects of bias and constants of the accelerometer, from (n, 3, 3, 4)."""
        return (x[:, :, :, 0] @ (np.eye(3) - self.by_accel),
                x[:, :, layout.ACCEL_AXIS, np.add(layout.ACCEL_SIGNAL, 1)])

    def _running_sums(self, step: Floats) -> tuple[Floats, Floats]:
        """Return the sums since the start of the interval before each step, and over intervals."""
        total = np.cumsum(step, axis=0)
        before = total - step
        start = before[self.first]
        return before - start[self.interval], total[self.end - 1] - start

    def find_steps(self, t: Floats, interval: Ints) -> Ints:
        """Return the step that each time lies in."""
        return np.clip(np.searchsorted(self.t, t, side='right') - 1, self.first[interval],
                       self.end[interval] - 1)

    def sum_effects(self, steps: Ints) -> None:
        """
        Sum the effects of IMU errors in the steps up to each cut: interval starts and ``steps``.

        An error in a step rotates the rest of dv and dp, or adds a force for the remaining time.
        ``_effects`` has the factors that depend on the end. moment : integral of f t over a step,
        divided by dt.   R_growth : R times ``growth``, effect of a rotation within the step.
        """
        self.cuts = np.unique(np.concatenate([self.first, steps]))
        dt, signals = self.dt[:, None], self.signals
        end, v, p = self.time_since_start[:, None] + dt, self.v + self.step_v, self.p + self.v * dt
        moment, R_growth = self.step_v - self.step_p / dt, self.R @ self.growth
        gyro_signals, sums = signals[:, GYRO_COLUMNS], self._sums_before_cuts
        self.effects = [
            sums(self.R_mean, signals),      # rotation and v; then v by rotations, p by rotations,
            sums(_cross(v, self.R_mean) - _cross(moment, R_growth), gyro_signals),
            sums(_cross(p + self.step_p - v * end, self.R_mean)
                 + _cross(moment * end - self.step_v * (dt / 6), R_growth), gyro_signals),
            sums(self.R_double - self.R_mean * end[:, :, None],      # and p by forces
                 signals[:, ACCEL_COLUMNS])]

    def _sums_before_cuts(self, step: Floats, signals: Floats) -> Floats:
        """Return the sums of (n, 3, 3) times signals (n, s) before each cut and up to the last."""
        out = np.zeros((len(self.cuts) + 1, 3, 3, signals.shape[1]))
        np.add.reduceat(_times(step, signals), self.cuts, out=out[1:])
        return np.cumsum(out, axis=0, out=out)

    def _effects(self, begin: Ints, end: Ints, dv: Floats, dp: Floats,
                 tau: Floats) -> dict[str, Floats]:
        """
        Return A to dp_by_gyro of ``Intervals`` by name, from errors in steps between (m,) cuts.

        dv, dp : (m, 3) at the end.   tau : (m, 1, 1) s, from the start to the end.
        """
        first, last = (np.searchsorted(self.cuts, x) for x in (begin, end))
        by_all, velocity, position, position_by_force = (x[last] - x[first] for x in self.effects)
        by_turn, force = self._gyro_effects(by_all[..., GYRO_COLUMNS]), by_all[..., ACCEL_COLUMNS]
        velocity = self._gyro_effects(velocity)
        A, F = self._accel_effects(force)
        AA, FF = self._accel_effects(force * tau[..., None] + position_by_force)
        return {'A': A, 'AA': AA, 'F': F, 'FF': FF, 'R_by_gyro': by_turn,
                'dv_by_gyro': _cross(dv, by_turn) - velocity,
                'dp_by_gyro': _cross(dp, by_turn) - velocity * tau - self._gyro_effects(position)}

    def intervals(self, travel: Callable[[Floats], Floats], forward: Floats) -> Intervals:
        """Return the sums of each interval."""
        T, ds = self.t[self.end] - self.t[self.first], np.diff(travel(self.t))[:, None]
        S = self.R_mean * ds[:, :, None]      # of each step
        path_before, path = self._running_sums(S @ forward)
        path_after = path[self.interval] - path_before - S @ forward
        turn_x, forward_x = skew(self.turn), skew(forward)
        in_step = forward_x / 2 + (turn_x @ forward_x + skew(np.cross(self.turn, forward))) / 6
        S_by_gyro = np.add.reduceat(_times(
            _cross(path_after, self.R_mean) + self.R @ in_step * ds[:, :, None],
            self.signals[:, GYRO_COLUMNS]), self.first)
        effects = self._effects(self.first, self.end, self.dv, self.dp, T[:, None, None])
        rate, force = np.hsplit(np.add.reduceat(self.signals[:, 1:7], self.first) / T[:, None], 2)
        return Intervals(T, self.R_end, self.dv, self.dp, **effects,
                         S=np.add.reduceat(S, self.first), S_by_gyro=self._gyro_effects(S_by_gyro),
                         mean_rate=rate, mean_force=force,
                         longest_step=np.maximum.reduceat(self.longest, self.first))

    def points(self, t: Floats, j: Ints, interval: Ints, first: int) -> Points:
        """Return sums to times t in steps j; interval : in the chunk.   first : its first one."""
        # rate and force change uniformly within a step
        h, dt = (t - self.t[j])[:, None], self.dt[j, None]
        force_change = (6 * self.step_v[j] - 12 * self.step_p[j] / dt) / dt**2
        force = self.step_v[j] / dt - force_change * dt / 2
        dv = self.v[j] + force * h + force_change * h**2 / 2
        dp = self.p[j] + self.v[j] * h + force * h**2 / 2 + force_change * h**3 / 6
        rate_change = 6 * (self.turn[j] - 2 * self.turn_mean[j]) / dt**2
        rate = self.turn[j] / dt - rate_change * dt / 2
        R = self.R[j] @ exp_so3(rate * h + rate_change * h**2 / 2)
        tau = t - self.t[self.first[interval]]
        effects = self._effects(self.first[interval], j, dv, dp, tau[:, None, None])
        # errors in the step up to the time
        share, signals = (h / dt)[:, None], self.signals[j]
        turn = self._gyro_effects(_times(self.R_mean[j] * share, signals[:, GYRO_COLUMNS]))
        step_dv, accel = self.step_v[j] * (h / dt), signals[:, ACCEL_COLUMNS]
        A, F = self._accel_effects(_times(self.R_mean[j] * share, accel))
        AA, FF = self._accel_effects(_times(self.R_double[j] * share**2, accel))
        in_step = {'A': A, 'AA': AA, 'F': F, 'FF': FF, 'R_by_gyro': turn,
                   'dv_by_gyro': _cross(step_dv / 2, turn),
                   'dp_by_gyro': _cross(step_dv * h / 6, turn)}
        return Points(interval + first, tau, dv, dp, R,
                      **{name: x + in_step[name] for name, x in effects.items()},
                      force=force + force_change * h, rate=rate + rate_change * h,
                      rate_change=rate_change, measured=signals[:, 1:7] / dt)
