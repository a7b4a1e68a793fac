# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of fixes that a receiver has dead-reckoned without satellites.

Its position jumps when satellites return. The fixes before the jump are smooth: the change of
their displacement from second to second agrees with odometer and IMU far better than elsewhere.
The jump is the sum of their errors, so these fixes contain no information on the scale.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Bools, Complexes, Floats, Ints
from odocal_ros.nav.time_series import MISSING_INTERVALS
from odocal_ros.reasons import Code, Reason

COMPARISON_INTERVAL = 1.0     # s between the fixes that are compared: judgement
MIN_DISPLACEMENT = 1.0      # m in this time, judgement: displacements then have a direction
# judgement: a displacement is smooth if its deviation from odometer and gyro is below a quarter of
# the median deviation, or below half of it and 3 cm, the noise of odometer and gyro
SMOOTH_LIMIT, FINE_SHARE, FINE_LIMIT = 0.25, 0.5, 0.03
# judgement: compared fixes of a smooth section, and smooth share of them; white noise reaches it
# three times in 10^8 (a quarter), or in 10^4 (half)
SMOOTH_ROWS, SMOOTH_SHARE = 10, 0.7
# least deviation of a jump, in medians and m. Judgement: white noise exceeds three medians once in
# 500 seconds, after a smooth section
JUMP_SIZE, SHORTEST_JUMP = 3.0, 0.5
# s, physical: in 0.1 s a change of acceleration by 5 m/s^2 (hard braking) gives SHORTEST_JUMP
JUMP_DELAY = 0.1
SPANS_LISTED = 3           # judgement: number of spans in a reason


class DeadReckonedSpan(NamedTuple):
    """Fixes that a receiver has dead-reckoned."""

    begin: float    # s, first fix
    end: float      # s, first fix after them
    jump: float     # m, at the end


def dead_reckoned_fixes(t_fix: Floats, fixes_n: Floats, sigma: Floats,
                        track: Complexes) -> tuple[Bools, tuple[Reason, ...]]:
    """
    Return a mask of fixes that a receiver has dead-reckoned, and FIXES_DEAD_RECKONED.

    t_fix : (k,) s.   fixes_n : (k, 3) m.   sigma : (k,) stated, of an axis, m.   track : (k,)
    positions of the antenna by odometer and gyro, m, with any first heading, scale within 30 %.
    """
    spans = _dead_reckoned_spans(t_fix, fixes_n[:, 0] + 1j * fixes_n[:, 1], sigma, track)
    is_reckoned = np.zeros(len(t_fix), bool)
    for begin, end, _ in spans:
        is_reckoned |= (t_fix >= begin) & (t_fix < end)
    if not spans:
        return is_reckoned, ()
    listed = ', '.join(f't = {begin:.0f} to {t_fix[t_fix < end][-1]:.0f} s (jump of {jump:.1f} m)'
                       for begin, end, jump in spans[:SPANS_LISTED])
    more = f' and {len(spans) - SPANS_LISTED} more' * (len(spans) > SPANS_LISTED)
    return is_reckoned, (Reason(
        Code.FIXES_DEAD_RECKONED, f'fixes were dead-reckoned at {listed}{more}: '
        f'{int(is_reckoned.sum())} of {len(t_fix)} fixes not used'),)


def _dead_reckoned_spans(t: Floats, positions: Complexes, sigma: Floats,
                         track: Complexes) -> list[DeadReckonedSpan]:
    """Return the spans of dead-reckoned fixes; arguments as for ``dead_reckoned_fixes``."""
    if len(t) <= SMOOTH_ROWS:
        return []
    step = min(max(1, round(COMPARISON_INTERVAL / float(np.median(np.diff(t))))), len(t) - 1)
    t, positions, sigma, track = t[::step], positions[::step], sigma[::step], track[::step]
    rows, deviation, in_motion = _deviations(t, np.diff(positions), np.diff(track))
    if not len(rows):
        return []
    usual, driven_rows = float(np.median(deviation[in_motion])), rows[in_motion]
    smooth = deviation[in_motion] < max(SMOOTH_LIMIT * usual, min(FINE_LIMIT, FINE_SHARE * usual))
    spans: list[DeadReckonedSpan] = []
    # jumps below the stated error are caused by changes of satellites
    jump_limit = np.maximum(max(JUMP_SIZE * usual, SHORTEST_JUMP), sigma[rows])
    for k in np.flatnonzero(deviation > jump_limit):
        last = int(np.searchsorted(driven_rows, rows[k]))
        first = _smooth_begin(smooth[:last])
        if first == last:
            continue
        # fixes since the previous compared one may be dead-reckoned too
        begin = float(t[max(driven_rows[first] - 2, 0)])
        # the row after a jump has the same deviation
        if not spans or begin > spans[-1].end:
            spans.append(DeadReckonedSpan(begin, float(t[rows[k] + 1]), float(deviation[k])))
    return spans


def _deviations(t: Floats, fix_steps: Complexes,
                track_steps: Complexes) -> tuple[Ints, Floats, Bools]:
    """
    Return rows of fix_steps, their deviations, m, and True if they and the rows before are moving.

    t : (k,) s.   fix_steps, track_steps : (k - 1,) displacements by fixes and by the track, m. The
    ratio of the two, a scale and a rotation, should be that of the last row in motion before,
    which may not be adjacent: a jump may come at a standstill. Empty with too few rows in motion.
    """
    dt = np.diff(t)
    complete = dt < MISSING_INTERVALS * np.median(dt)
    moving = complete & (np.abs(track_steps) > MIN_DISPLACEMENT)
    before = np.maximum.accumulate(np.where(moving, np.arange(len(track_steps)), -1))[:-1]
    rows = np.flatnonzero(complete[1:] & (before >= 0)) + 1
    before = before[rows - 1]
    in_motion = moving[rows] & (before == rows - 1)
    if in_motion.sum() <= SMOOTH_ROWS:
        return rows[:0], np.empty(0), in_motion[:0]
    ratio = fix_steps[before] / track_steps[before]
    acceleration = np.gradient(track_steps) / np.median(dt)
    change = acceleration[rows] - acceleration[before] * track_steps[rows] / track_steps[before]
    deviation = _without_delay(fix_steps[rows] - ratio * track_steps[rows], ratio * change)
    return rows, deviation, in_motion


def _without_delay(deviation: Complexes, delay_rate: Complexes) -> Floats:
    """Return sizes of deviations, (n,) m, without the part by a common delay; delay_rate: m/s."""
    size = np.maximum(np.abs(delay_rate), 1e-9)
    delays = (deviation * delay_rate.conj()).real / size**2
    order = np.argsort(delays)
    weight = np.cumsum(size[order])
    delay = delays[order[np.searchsorted(weight, weight[-1] / 2)]]    # weighted median
    return np.asarray(np.abs(deviation - delay * delay_rate * (abs(delay) > JUMP_DELAY)))


def _smooth_begin(smooth: Bools) -> int:
    """Return the first row of the smooth section at the end, or the length if there is none."""
    begin = len(smooth)
    while begin >= SMOOTH_ROWS and smooth[begin - SMOOTH_ROWS:begin].mean() >= SMOOTH_SHARE:
        begin -= 1
    return begin if begin == len(smooth) else begin - SMOOTH_ROWS + 1 + int(
        np.argmax(smooth[begin - SMOOTH_ROWS + 1:]))
