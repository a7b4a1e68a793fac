# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Noise of the motion in an interval between keyframes: docs/method.md (S13).

An interval has 18 rows (motion.py): position, velocity, attitude, the biases of gyro and
accelerometer, and the displacement of the odometer. Their covariance is a sum over independent
noises: of the IMU, of the road under the wheels, and known ones such as gaps. ``IntervalNoise``
has the effects of each noise on the rows at unit variance. Those of IMU and road are multiplied by
the roots of their levels, the variances that the fit estimates.

White noise at a time within the interval affects the rest of the interval. The integral over that
time is a two-point Gauss rule: exact up to the third order, and 3 % off for the small terms of
fourth order (position from gyro noise).

Sideslip is observable in turns: a leg with turns uses its own estimate. On a straight leg a
constant sideslip cannot be separated from the mounting yaw: the noise of an ordinary road is the
lower limit, even if the residuals of single seconds are smaller.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.estimator.factors.factor import IMU, IMU_NOISE, JUMP, VARIANCE_FACTOR_COUNT
from odocal_ros.estimator.factors.motion import D, Motion, ROWS
from odocal_ros.estimator.factors.odometer import stamp_of
from odocal_ros.estimator.imu import gyro_bias_at_rest, ImuSteps
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BA, BG, P, PHI, V
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import skew
from odocal_ros.nav.time_series import gaps_in_rhythm
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import SWAY

# m/sqrt(s), lower limit of sideslip noise if turns determine it. Tuned: the yaw sigma of simulated
# vehicles, which do not slide, then matches their errors (docs/decisions/0005)
MIN_TURN_SIDESLIP = 2e-4
# m/sqrt(s), lower limit of vertical motion that the unknowns do not describe: springs, tyres,
# road. Tuned: with a tenth of it, pitch was 3 sigmas off on drives in yards (docs/decisions/0005)
MIN_VERTICAL_NOISE = 2e-3
# m/rad, unmodelled lift of the axle per pitch of the body within an interval, as from kerbs
# shorter than a wheelbase: initial value and lower limit, judgement; the value is estimated for
# each drive
PITCHING, MIN_PITCHING = 0.03, 1e-4
MIN_ROAD_NOISE = 2e-4   # m/sqrt(s) along the path, physical: texture of the road under a tyre
# m/sqrt(s), an ordinary road: physical, a body's sway, white at 10 Hz
ORDINARY_ROAD = SWAY / np.sqrt(10.0)
# rad, total turn angle: one corner does not determine sideslip, two do. Judgement
CORNER_ANGLE = np.pi / 2
# levels of the motion that the odometer does not measure: those along the path, and those whose
# lower limit is that of sideslip
ALONG, SIDEWAYS = ('along', 'along_hard'), ('side', 'side_turn', 'up')
# all of them, m^2/s, with the index of their axis: forward, left, up. _hard: while accelerating or
# braking; _turn: in turns; pitching: m^2/rad^2, from the pitch of the body within the interval
ROAD = {'along': 0, 'along_hard': 0, 'side': 1, 'side_turn': 1, 'up': 2, 'pitching': 2}
INTERVAL = (*IMU, *ROAD)    # all levels of an interval
# definition: Gauss and Legendre's nodes and weights on 0 to 1
GAUSS_X, GAUSS_W = (np.polynomial.legendre.leggauss(2)[0] + 1) / 2, \
    np.polynomial.legendre.leggauss(2)[1] / 2
# rad/s: above it, a vehicle may slide sideways. Judgement: 0.5 m/s^2 at 10 m/s
TURNING_RATE = 0.05
# m, minimum error of the travel of an interval at rest: physical, play of a drive train
MIN_REST_NOISE = 5e-4
# rad/s, m/s^2, 1 sigma of the unknown motion within a gap: judgement, of a car in town
GAP_RATE, GAP_FORCE = 0.1, 1.5
# definition: rows with variances that are not estimated, equal on all three axes; the last is
# the odometer
KNOWN = (P, V, PHI, D)
KNOWN_ROWS, ODOMETER = np.concatenate([np.arange(ROWS)[rows] for rows in KNOWN]), 3
ABSENT_VARIANCE = 1e4   # m^2, variance of travel that is not observed


def total_turn(leg: SmootherLeg, imu: ImuSteps) -> float:
    """Return the sum of the absolute angles of turns faster than TURNING_RATE, rad."""
    t = imu.t_keyframes
    T = np.diff(t)
    bias = gyro_bias_at_rest(leg, imu)
    turn = imu.over_intervals(imu.turn) - (0.0 if bias is None else bias) * T[:, None]
    up = imu.signals[:, 3:].sum(axis=0)
    angle = np.abs(turn @ up) / np.linalg.norm(up)
    path = np.abs(np.diff(leg.travel.at(t))) * leg.rough_scale
    moving = path > 0.2 * T     # m/s
    return float(angle[moving & (angle > TURNING_RATE * T)].sum())


def min_sideslip(angle: float) -> float:
    """Return the lower limit of sideslip noise, m/sqrt(s); angle : rad, of all turns of a leg."""
    corners = np.clip((angle - CORNER_ANGLE) / CORNER_ANGLE, 0.0, 1.0)
    return float(ORDINARY_ROAD * (MIN_TURN_SIDESLIP / ORDINARY_ROAD)**corners)


def road_levels(total_turn: float) -> tuple[dict[str, float], dict[str, float]]:
    """Return initial values and lower limits of ROAD; total_turn : rad."""
    sideslip, road = min_sideslip(total_turn)**2, 0.01**2      # m^2/s; road: initial
    return (dict.fromkeys(ALONG, road) | dict.fromkeys(SIDEWAYS, max(road, sideslip))
            | {'pitching': PITCHING**2},
            dict.fromkeys(ALONG, MIN_ROAD_NOISE**2) | dict.fromkeys(SIDEWAYS, sideslip)
            | {'up': max(sideslip, MIN_VERTICAL_NOISE**2), 'pitching': MIN_PITCHING**2})


def assumed_noise_reasons(problem: Problem, levels: Levels) -> list[Reason]:
    """Return the reason that reports an assumed road noise, if it affects the result."""
    limit = problem.min_levels['side']
    if limit < 2e-3**2 or all(      # m^2/s, smallest that is reported
            levels[name] > 1.01 * limit for name in SIDEWAYS):
        return []
    return [Reason(
        Code.PARAMETER_NOT_DETERMINED, 'not observable on this drive: sideslip; turns faster than '
        f'{np.rad2deg(TURNING_RATE):.0f} deg/s add up to '
        f'{np.rad2deg(problem.total_turn):.0f} deg, less than the limit of '
        f'{np.rad2deg(2 * CORNER_ANGLE):.0f} deg. '
        f'{1e3 * np.sqrt(limit):.0f} mm/√s of sideslip are assumed; the uncertainties of the '
        'mounting angles depend on this value', 'Drive with left and right turns.')]


@dataclass(eq=False)
class IntervalNoise:
    """
    The independent noises of K intervals.

    Estimated are c unit noises: those of IMU at the Gauss points, three axes each, then those of
    ROAD. Their effects, (K, 18, c), are computed for some intervals at a time.
    """

    motion: Motion
    axes: Floats                # (K, 3, 3) axes of the vehicle in n; rows: forward, left, up
    imu: Floats                 # (K, 4) roots of the variance factors of IMU
    road: Floats                # (K, 6) displacement by unit noises of ROAD along their axes
    known_variances: Floats     # (K, 4) of the rows of KNOWN, not estimated
    known_columns: Floats       # (K, 18, g) effects of unit noises that are not estimated either
    component: ClassVar[Ints] = np.array(       # (c,) index in INTERVAL of each unit noise
        len(GAUSS_X) * [INTERVAL.index(name) for name in IMU for _ in range(3)]
        + [INTERVAL.index(name) for name in ROAD])

    def columns(self, rows: slice) -> Floats:
        """Return the effects of unit noises on the rows of a slice of intervals: (k, 18, c)."""
        motion = self.motion.take(rows)
        T, C = motion.T[:, 0], motion.C
        force, displacement = skew(motion.dv / motion.T), skew(motion.displacement / motion.T)
        eye = np.eye(3)
        out = np.zeros((len(T), ROWS, len(self.component)))
        imu_columns = 3 * len(IMU)      # of each Gauss point
        for point, (x, weight) in enumerate(zip(GAUSS_X, GAUSS_W, strict=True)):
            u = ((1 - x) * T)[:, None, None]        # s, from the noise to the end
            at_point = out[:, :, imu_columns * point:imu_columns * (point + 1)]
            gyro, accel, gyro_walk, accel_walk = (
                at_point[:, :, first:first + 3] for first in range(0, imu_columns, 3))
            gyro[:, PHI], gyro[:, V] = -eye, force * u
            gyro[:, P], gyro[:, D] = force * (u**2 / 2), displacement * u
            accel[:, V], accel[:, P] = eye, eye * u
            gyro_walk[:, PHI], gyro_walk[:, V] = -C * u, force @ C * (u**2 / 2)
            gyro_walk[:, P] = force @ C * (u**3 / 6)
            gyro_walk[:, D], gyro_walk[:, BG] = displacement @ C * (u**2 / 2), eye
            accel_walk[:, V], accel_walk[:, P] = -C * u, -C * (u**2 / 2)
            accel_walk[:, BA] = eye
            root = np.sqrt(weight * T)[:, None] * np.repeat(self.imu[rows], 3, axis=1)
            at_point *= root[:, None]
        for k, axis in enumerate(ROAD.values()):
            out[:, D, imu_columns * len(GAUSS_X) + k] = (
                self.axes[rows, axis] * self.road[rows, k, None])
        return out

    def variance_ratios(self, level_ratios: dict[str, float]) -> Floats:
        """
        Return ratios of variances, new to old, by the ratios of levels: (K, 7).

        They are in the order of VARIANCE_FACTORS, without the last one, the jump of the fixes.
        """
        out = np.ones((len(self.road), JUMP))
        out[:, IMU_NOISE] = [level_ratios[name] for name in IMU]
        for column, (name, axis) in enumerate(ROAD.items()):
            out[:, axis] = np.where(self.road[:, column] > 0, level_ratios[name], out[:, axis])
        return out

    def covariance(self, units: Floats, rows: slice) -> Floats:
        """Return the covariances of some intervals, (k, 18, 18); units : effects in sigmas."""
        Q = units @ np.swapaxes(units, 1, 2)
        known = self.known_columns[rows]
        Q += known @ np.swapaxes(known, 1, 2)
        Q[:, KNOWN_ROWS, KNOWN_ROWS] += np.repeat(self.known_variances[rows], 3, axis=1)
        return Q


def motion_noise(motion: Motion, leg: SmootherLeg, rest: Bools,
                 variance_factors: Floats | None) -> IntervalNoise:
    """
    Return the noises of a motion.

    rest : (K,) intervals at standstill, whose odometer noise is known: it is independent of that
    in motion.   variance_factors : (K, VARIANCE_FACTOR_COUNT) of outlier intervals; None: 1.
    """
    K, T = len(motion.T), motion.T[:, 0]
    axes = np.swapaxes(motion.C_end @ motion.state.C_bv, 1, 2)      # rows: forward, left, up
    axes = axes + np.swapaxes(motion.C @ motion.state.C_bv, 1, 2)
    axes = axes / np.linalg.norm(axes, axis=2, keepdims=True)
    speed = np.linalg.norm(motion.displacement, axis=1) / T
    root_path = np.sqrt(np.clip(speed, 0.02, 1.0) * T)      # not zero if a wheel hardly turns
    accelerating, turning = accelerating_and_turning(motion)
    if variance_factors is None:
        variance_factors = np.ones((K, VARIANCE_FACTOR_COUNT))
    magnitudes = (root_path * ~accelerating, root_path * accelerating, root_path * ~turning,
                  root_path * turning, root_path, np.sqrt(2 * motion.half_pitch_variance))
    road = np.stack([magnitude * ~rest * np.sqrt(variance_factors[:, axis])
                     for axis, magnitude in zip(ROAD.values(), magnitudes, strict=True)], -1)
    known_variances = _known_variances(motion, leg)
    rest_variance = rest_noise(speed, rest)
    known_variances[rest, ODOMETER] += rest_variance
    slow = ~rest & (speed < 1.0)
    known_variances[slow, ODOMETER] += rest_variance * (1 - speed[slow])
    return IntervalNoise(motion, axes, np.sqrt(variance_factors[:, IMU_NOISE]), road,
                         known_variances, _known_columns(motion, leg, axes, rest))


def _known_columns(motion: Motion, leg: SmootherLeg, axes: Floats, rest: Bools) -> Floats:
    """
    Return the effects of unit errors of a quantised speed on the rows: (K, 18, g).

    Fine steps are rounding noise, g = 1. Coarse steps, g = 2, are not used along the path;
    ``SpeedSteps`` uses their transitions. In a turn, a quantisation error that changes within the
    interval displaces the end sideways: if it changes by q from the first half to the second, by
    q T / 8 times the angle of the turn.
    """
    coarse = leg.travel.coarse
    if coarse is None:
        return np.zeros((len(rest), ROWS, 0))
    if not leg.uses_speed_steps:
        sigma = motion.state.scale * np.sqrt(coarse.travel_variance(motion.state.t))
        columns = np.zeros((len(rest), ROWS, 1))
        columns[:, D, 0] = axes[:, 0] * sigma[:, None]
        return columns * ~rest[:, None, None]
    # first column: unknown path length along the rolling direction, without pitching of the body
    size = np.linalg.norm(motion.wheel_displacement, axis=1, keepdims=True)
    along = np.where(size > 1e-3, motion.wheel_displacement / np.maximum(size, 1e-3), axes[:, 0])
    turn_angle = motion.turning * motion.T[:, 0]
    path_error = motion.state.scale * coarse.max_error * motion.T[:, 0]
    columns = np.zeros((len(rest), ROWS, 2))
    columns[:, D, 0] = along * np.sqrt(ABSENT_VARIANCE)
    columns[:, D, 1] = axes[:, 1] * (path_error * turn_angle / 8)[:, None]
    return columns * ~rest[:, None, None]


def rest_noise(speed: Floats, rest: Bools) -> float:
    """Return the variance of the travel of an interval at rest, m^2; speed : (K,) m/s."""
    measured = float((speed[rest]**2).mean()) if rest.sum() >= 5 else 0.0      # s: judgement
    return max(measured, MIN_REST_NOISE**2)


def accelerating_and_turning(motion: Motion) -> tuple[Bools, Bools]:
    """Return masks of the intervals with acceleration or braking, and with turns: (K,) each."""
    # above 0.5 m/s^2 a wheel may slip, above TURNING_RATE it may slide
    T = motion.T[:, 0]
    speed = np.einsum('ki,ki->k', motion.displacement, (motion.f_n + motion.f_n_end) / 2) \
        / motion.state.scale / T
    padded = np.pad(speed, 1, mode='edge')
    return np.abs(padded[2:] - padded[:-2]) > 0.5 * 2 * T, motion.turning > TURNING_RATE


def _known_variances(motion: Motion, leg: SmootherLeg) -> Floats:
    """Return variances of the motion within gaps and outside the odometer samples: (K, 4)."""
    sums, T = motion.sums, motion.T[:, 0]
    variances = np.zeros((len(T), len(KNOWN)))
    # s: motion within a longer step between IMU samples is unknown
    gap = np.where(sums.longest_step > max(0.06, 3 * np.median(sums.longest_step)),
                   sums.longest_step, 0.0)
    variances[:, :ODOMETER] = np.stack(
        [GAP_FORCE * gap * T, GAP_FORCE * gap, GAP_RATE * gap], -1)**2
    t, travel = motion.state.t, leg.travel
    stamp = stamp_of(t, motion.state.constants)
    outside = (stamp[:-1] < travel.t[0]) | (stamp[1:] > travel.t[-1])
    variances[outside, ODOMETER] = ABSENT_VARIANCE
    variances[:, ODOMETER] += _gap_variances(stamp, travel, motion.state.scale)
    for t_step, sigma in zip(leg.uncertain_t, leg.uncertain_sigma, strict=True):
        k = np.searchsorted(t, t_step) - 1
        if 0 <= k < len(T) and sigma > 0:
            intervals = slice(max(k - 1, 0), k + 2)       # the gap may begin one interval earlier
            variances[intervals, ODOMETER] += (motion.state.scale * sigma)**2
    return variances


def _gap_variances(stamp: Floats, travel: Travel, scale: float) -> Floats:
    """Return variances of travel that is interpolated across gaps of the odometer: (K,) m^2."""
    # a speed that rises and falls within a gap differs from the mean by up to half the gap times
    # its acceleration; an interval contains at most the travel of the whole gap
    variance = np.zeros(len(stamp) - 1)
    for begin, end in gaps_in_rhythm(travel.t):
        inside = (stamp[1:] > begin) & (stamp[:-1] < end)
        T = np.minimum(np.diff(stamp)[inside], (end - begin) / 4)
        path = scale * abs(float(np.diff(travel.at(np.array([begin, end])))[0]))
        variance[inside] += np.minimum(GAP_FORCE * (end - begin) * T / 2, path)**2
    return variance
