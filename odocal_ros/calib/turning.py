# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Turns by the gyro compared with turns of the course, to detect a wrong sign or unit."""

import numpy as np

from odocal_ros.calib.check import ONE_MOTION_RATIO
from odocal_ros.calib.drive import knots_of
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.angles import arctan2
from odocal_ros.nav.integral import integral_at, twice_integral_at
from odocal_ros.nav.local_frame import GNSS_MOVES
from odocal_ros.nav.statistics import gaps_longer
from odocal_ros.reasons import Code, Reason

# statistical: least correlation of the same turns by gyro and by course, and least sigmas of the
# slope, since a few courses may be correlated by chance
SAME_TURNS, SLOPE_SIGMAS = 0.9, 8.0
LONGEST_GAP = 1.0      # s, judgement: of the IMU, turns within a longer one are not measured
# rad^2, judgement: a chord with a U-turn in it, and the next, are off by 0.35 rad each (0.1 to 0.2
# for a mower whose rows are 1.6 m apart)
U_TURN = 0.25


def turn_ratio(t_imu: Floats, w_up: Floats, t_fix: Floats, fixes_n: Floats,
               sigma: float, least: float = GNSS_MOVES) -> float | None:
    """
    Return turns by the gyro over turns of the course by fixes: 1 if units and sign are right.

    None if the drive hardly turns or the two are not correlated.

    t_imu, w_up : (n,) s, and turn rate about the upward axis.   t_fix, fixes_n, sigma : (k,), (k,
    2 or more), float s, m, and m horizontally.   least : least significant motion of fixes, m.
    """
    covered = (t_fix >= t_imu[0]) & (t_fix <= t_imu[-1])      # turns outside are not measured
    t_fix, fixes_n = t_fix[covered], fixes_n[covered]
    # m: the sigma of a course is then 0.14 rad
    knots = knots_of(fixes_n, max(min(5.0, least), 10 * sigma))
    if len(knots) < 5:
        return None
    ends = t_fix[knots]
    gaps = gaps_longer(t_imu, LONGEST_GAP)
    since, until = (np.searchsorted(edge, ends) for edge in gaps.T)     # gaps before each end
    keep = ~_pivots(ends, integral_at(ends, t_imu, w_up)) & (until[1:] == since[:-1]) & (
        since[1:] == since[:-1])
    step = np.diff(fixes_n[knots, :2], axis=0)[keep]
    t = ((ends[:-1] + ends[1:]) / 2)[keep]
    course = np.unwrap(arctan2(step[:, 1], step[:, 0]))
    # the mean angle over each chord; the effect of a bias is linear in time
    gyro = (np.diff(twice_integral_at(ends, t_imu, w_up)) / np.diff(ends))[keep]
    # at a sudden U-turn of the course the vehicle may have reversed, and the turn in a gap of the
    # IMU is unknown: a free step is fitted there
    about = np.flatnonzero((np.abs(np.diff(course)) > 2.0) | (np.diff(until[1:][keep]) > 0))
    drift = np.column_stack([np.ones_like(t), t, np.arange(len(t))[:, None] > about])
    course, gyro = (x - drift @ np.linalg.lstsq(drift, x, rcond=None)[0] for x in (course, gyro))
    power = float(gyro @ gyro)
    # rad^2: turns of 1 rad in total, root sum of squares, plus the error of chords at U-turns
    if course @ course < 1.0 + U_TURN * len(about) or power == 0:
        return None
    slope = float(course @ gyro / power)      # of the noisy one on the clean one: no bias
    explained = slope**2 * power / (course @ course)      # share of the course's variance
    certain = explained * (len(t) - 1 - drift.shape[1]) > SLOPE_SIGMAS**2 * (1 - explained)
    return 1 / slope if explained > SAME_TURNS**2 and certain else None


def _pivots(ends: Floats, angle: Floats) -> Bools:
    """Return a mask of the chords in which a vehicle stops and turns: (n,), angle in rad."""
    lasts, turns = np.diff(ends), np.abs(np.diff(angle))
    # judgement: ratio to the median duration, and rad: the mean over time is not that over path
    return (lasts > 3.0 * np.median(lasts)) & (turns > 0.5)


def gyro_reasons(ratio: float | None, gyro_scale: float) -> tuple[Reason, ...]:
    """Return GYRO_SIGN or IMU_UNITS if ``turn_ratio`` shows it; gyro_scale: as configured."""
    if ratio is None or ONE_MOTION_RATIO[0] < ratio < ONE_MOTION_RATIO[1]:
        return ()
    if ratio < -ONE_MOTION_RATIO[0]:
        return (Reason(Code.GYRO_SIGN, 'turns by the gyro are opposite to those by the fixes '
                       f'(ratio {ratio:.2f} instead of 1)'),)
    degrees = 40.0 < ratio < 80.0       # 180 / pi, with a margin for scale errors and skid
    if abs(ratio) < 0.01:       # no error of the unit: revolutions give 0.16
        return (Reason(Code.IMU_UNITS, f'turns by the gyro are only {ratio:#.2g} times those by '
                       'the fixes', 'Set imu.mounting_rpy if another IMU '
                       'axis is vertical; otherwise correct the IMU driver.'),)
    wanted = gyro_scale * (np.pi / 180 if degrees else 1 / ratio)
    return (Reason(Code.IMU_UNITS, f'turns by the gyro are {ratio:#.3g} times those by the '
                   'fixes' + ', typical for deg/s' * degrees,
                   f'Set imu.gyro_scale to {wanted:.10g}, or correct the unit in the IMU '
                   'driver.'),)
