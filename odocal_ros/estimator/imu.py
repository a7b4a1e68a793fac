# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
IMU samples of a leg: their sums over steps of a tenth of a second, and their noise.

A step has the rotation vector, and the single and double integral of the specific force in the
axes at its start, with coning and sculling at the sample rate (two-speed strapdown, Savage 1998).
The passes of a fit integrate steps instead of samples: errors of the IMU are constant within a
step. The noise functions return sigmas from the grade of the IMU, standstills or samples.
"""

from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.data.arrays import (
    Bools,
    Floats,
    Ints,
    map_rows,
    map_windows,
    median,
    release_mapped_memory,
    runs,
)
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.nav import rotations
from odocal_ros.nav.strapdown import prefix_product, rotation_increments
from odocal_ros.screening.leg_kind import TILT_SIGMA
from odocal_ros.settings.nominal import G, Grade

# s. Tuned: with 0.02 s the results of six drives differ by 0.04 sigma rms, at most 0.19, and a fit
# takes 1.6 times the time (docs/decisions/0020)
STEP = 0.1
# judgement: samples, so that their arrays stay in the cache; keyframes, which limits the memory
SAMPLES_IN_CACHE, KEYFRAMES_IN_CACHE = 8192, 64
# judgement, without an accelerometer: white noise, m/s^2/sqrt(Hz), for vehicle accelerations of
# 1.5 m/s^2 for some seconds; random walk, m/s^2/sqrt(s), for slopes of a few per cent over a
# minute
NO_ACCEL_NOISE, NO_ACCEL_WALK = 5.0, 0.01
# lower limits: white noises, rad/s and m/s^2 per sqrt(Hz), and walks of the biases, the same per
# sqrt(s). Physical: a tenth of navigation grade, since a sensor with a dead band has none at rest
MIN_IMU_NOISE = {'gyro': 3e-8, 'accel': 1e-5, 'gyro_walk': 2e-11, 'accel_walk': 1e-7}
CHI2_3_MEDIAN = 2.366       # statistical: median of chi2 with 3 degrees of freedom
CHI2_3_QUARTILE = 1.213     # statistical: its lower quartile


def imu_rows(leg: SmootherLeg) -> tuple[int, Floats]:
    """Return the index of the first used IMU sample, and the times of all used samples, s."""
    first = int(np.searchsorted(leg.t_imu, leg.t_begin))
    return first, leg.t_imu[first:int(np.searchsorted(leg.t_imu, leg.t_stop, side='right'))]


def nearest_samples(t: Floats, times: Floats) -> Ints:
    """Return the indices of the samples at t that are nearest to some times."""
    k: Ints = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    k -= times - t[k - 1] < t[k] - times
    return k


def keyframe_samples(leg: SmootherLeg, spacing: float) -> Ints:
    """Return the indices of samples about ``spacing``, s, apart: (K + 1,), increasing."""
    first, t = imu_rows(leg)
    grid = np.linspace(t[0], t[-1], max(1, round((t[-1] - t[0]) / spacing)) + 1)
    return first + np.unique(nearest_samples(t, grid))


@dataclass(frozen=True, eq=False)
class ImuSteps:
    """
    The m steps of a leg, with keyframes at some of their ends.

    The sums contain all errors of the samples, and are in the axes of b at the start of the step.
    """

    turn: Floats        # (m, 3) rad, rotation vector from start to end
    turn_mean: Floats   # (m, 3) rad, mean of the turn over the step: half of it at constant rate
    dv: Floats          # (m, 3) m/s, integral of the specific force
    dp: Floats          # (m, 3) m, integral of dv
    signals: Floats     # (m, 6) integrals of turn rate, rad, and specific force, m/s, as measured
    longest: Floats     # (m,) s, longest time between two samples
    t: Floats           # (m + 1,) s, ends of the steps
    keyframes: Ints     # (K + 1,) indices of the keyframes in t

    @property
    def t_keyframes(self) -> Floats:
        """Return the times of the keyframes, s: (K + 1,)."""
        return self.t[self.keyframes]

    @classmethod
    def from_leg(cls, leg: SmootherLeg, spacing: float) -> 'ImuSteps':
        """Return the steps of a leg with keyframes about ``spacing``, s, apart."""
        return cls.between(leg, keyframe_samples(leg, spacing))

    @classmethod
    def between(cls, leg: SmootherLeg, keyframes: Ints) -> 'ImuSteps':
        """Return the steps of a leg; keyframes : (K + 1,) indices of their samples."""
        edges = np.append(np.concatenate([
            _edges(leg.t_imu, keyframes[k:k + KEYFRAMES_IN_CACHE + 1])[:-1]
            for k in range(0, len(keyframes) - 1, KEYFRAMES_IN_CACHE)]), keyframes[-1])
        parts, first = [], 0
        while first < len(edges) - 1:
            last = int(np.searchsorted(edges, edges[first] + SAMPLES_IN_CACHE, side='right')) - 1
            last = min(max(last, first + 1), len(edges) - 1)
            parts.append(_summed(leg, edges[first:last + 1]))
            first = last
            release_mapped_memory()
        return cls(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
                   t=leg.t_imu[edges], keyframes=np.searchsorted(edges, keyframes))

    def angle_covariances(self) -> Floats:
        """Return the scatter of the attitude in each interval: covariances (K, 3, 3) rad^2."""
        T = np.diff(self.t)
        angle = np.cumsum(self.turn, axis=0) - self.turn / 2      # in the middle of each step
        share = (T / np.repeat(self.over_intervals(T), np.diff(self.keyframes)))[:, None]
        mean = self.over_intervals(angle * share)
        square = self.over_intervals(angle[:, :, None] * (angle * share)[:, None])
        return square - mean[:, :, None] * mean[:, None]

    def over_intervals(self, x: Floats) -> Floats:
        """Return the sums of a quantity of the steps over the keyframe intervals: (K, ...)."""
        return np.add.reduceat(x, self.keyframes[:-1])


def _edges(t: Floats, keyframes: Ints) -> Ints:
    """Return the indices of the samples at the ends of steps, all keyframes included: sorted."""
    first, last = keyframes[[0, -1]]
    begin, T = t[keyframes[:-1]], np.diff(t[keyframes])
    step_count = np.maximum(1, np.round(T / STEP))
    interval = np.repeat(np.arange(len(T)), np.diff(keyframes))     # of each sample
    rounding = 1e-6     # of a step: a sample at the end of a step is not moved into it by rounding
    step = np.floor((t[first:last] - begin[interval]) / T[interval] * step_count[interval]
                    + rounding)
    is_first_of_step = np.r_[True, (np.diff(interval) > 0) | (np.diff(step) > 0)]
    out: Ints = np.append(np.flatnonzero(is_first_of_step), last - first) + first
    return out


def _summed(leg: SmootherLeg, edges: Ints) -> dict[str, Floats]:
    """
    Return the sums of m steps by their names in ``ImuSteps``.

    edges : (m + 1,) indices of the samples at the ends of the steps.
    """
    rows = slice(edges[0], edges[-1] + 1)
    t, f = leg.t_imu[rows], leg.f_b[rows]
    first = edges[:-1] - edges[0]
    step = np.repeat(np.arange(len(first)), np.diff(edges))     # of each sample
    dt = np.diff(t)[:, None]
    turn = rotation_increments(leg.t_imu, leg.w_b, edges[0], edges[-1]).T
    q = prefix_product(np.concatenate([[[0.0, 0.0, 0.0, 1.0]], rotations.quat_from_rotvec(turn)]))
    to_start = rotations.quat_conjugate(q[first])[step]
    at_start, at_end = (rotations.quat_multiply(to_start, x) for x in (q[:-1], q[1:]))
    # specific force at both ends of a sample interval, in the axes at the start of its step
    f_start, f_end = (np.einsum('nij,nj->ni', rotations.matrix_from_quat(attitude), force)
                      for attitude, force in ((at_start, f[:-1]), (at_end, f[1:])))
    last = np.append(first[1:], len(dt)) - 1

    def running(x: Floats) -> tuple[Floats, Floats]:
        """Return the sum within the step before each sample, and the sum of each step."""
        total = np.cumsum(x, axis=0)
        before = total - x
        return before - before[first][step], total[last] - before[first]

    v, dv = running((f_start + f_end) * dt / 2)
    _, dp = running(v * dt + (2 * f_start + f_end) * (dt**2 / 6))
    signals = np.concatenate([turn, (f[:-1] + f[1:]) / 2 * dt], axis=1)
    angle, _ = running(turn)
    mean = np.add.reduceat((angle + turn / 2) * dt, first) / np.add.reduceat(dt, first)
    return {'turn': rotations.rotvec_from_quat(at_end[last]), 'turn_mean': mean,
            'dv': dv, 'dp': dp, 'signals': np.add.reduceat(signals, first),
            'longest': np.maximum.reduceat(dt[:, 0], first)}


def sensor_noise(grade: Grade) -> dict[str, float]:
    """Return the sigmas of white noise and random walks of an IMU of this grade, SI, by level."""
    sigmas = {'gyro': grade.gyro_noise, 'accel': grade.accel_noise,
              'gyro_walk': grade.gyro_bias_walk, 'accel_walk': grade.accel_bias_walk}
    return {name: max(sigma, MIN_IMU_NOISE[name]) for name, sigma in sigmas.items()}


def without_accelerometer(grade: Grade) -> Grade:
    """Return a grade for an IMU without an accelerometer, whose specific force is gravity."""
    return replace(grade, accel_noise=NO_ACCEL_NOISE, accel_bias=TILT_SIGMA * G,
                   accel_bias_walk=NO_ACCEL_WALK, accel_scale_sigma=0.0,
                   gyro_by_force_sigma=0.0)


def white_noise_at_rest(imu: ImuSteps, leg: SmootherLeg, at_rest: Bools) -> dict[str, float]:
    """Return the white noise variances at standstills, by sensor: 'gyro', 'accel'; {}: too few."""
    turn, force = np.split(imu.over_intervals(imu.signals), 2, axis=1)
    T = np.diff(imu.t_keyframes)[:, None]
    stops = [slice(begin, end) for begin, end in runs(at_rest[:-1] & at_rest[1:])
             if end - begin > 2]
    # second differences contain no bias and no drift; their variance is six times as large
    powers = np.concatenate([np.zeros((2, 0)), *(
        [(np.diff((x / T)[stop], n=2, axis=0)**2).sum(axis=1) * T[stop][1:-1, 0] / 6
         for x in (turn, force)] for stop in stops)], axis=1)
    if powers.shape[1] < 15:    # of three axes each: with fewer, a variance has a sigma above 30 %
        return {}
    # people may get in and out, or load, during most of a stop: use the quarter with least motion
    variances = {
        name: max(min(np.median(x) / CHI2_3_MEDIAN, np.quantile(x, 0.25) / CHI2_3_QUARTILE),
                  MIN_IMU_NOISE[name]**2)
        for name, x in zip(('gyro', 'accel'), powers, strict=True)}
    return variances if leg.has_accelerometer else {'gyro': variances['gyro']}


def sample_noise(leg: SmootherLeg, rows: slice | Ints) -> dict[str, float]:
    """Return the white noise by differences of adjacent samples, SI per sqrt(Hz), by sensor."""
    def squared_differences(x: Floats) -> Floats:
        out: Floats = (np.diff(x, axis=0)**2).sum(axis=1)
        return out

    T = median(map_windows(np.diff, leg.t_imu[rows]))
    return {name: float(np.sqrt(median(map_windows(squared_differences, x[rows]))
                                / CHI2_3_MEDIAN / 2 * T))
            for name, x in (('gyro', leg.w_b), ('accel', leg.f_b))}


def is_standing(leg: SmootherLeg, t: Floats) -> Bools:
    """Return a mask of the times in a standstill and not within 0.5 s of its ends: (N,) bool."""
    def within(t: Floats) -> Bools:
        inside = np.zeros(len(t), bool)
        for begin, end in leg.standstills:
            inside |= (t >= begin + 0.5) & (t <= end - 0.5)
        return inside
    return map_rows(within, t)


def gyro_bias_at_rest(leg: SmootherLeg, imu: ImuSteps) -> Floats | None:
    """Return the mean turn rate at standstills, (3,) rad/s; None if they are shorter than 1 s."""
    first, last = imu.keyframes[[0, -1]]
    inside = is_standing(leg, imu.t[first:last + 1])
    at_rest = inside[:-1] & inside[1:]
    length = float(np.diff(imu.t[first:last + 1])[at_rest].sum())
    return None if length < 1.0 else imu.turn[first:last][at_rest].sum(axis=0) / length
