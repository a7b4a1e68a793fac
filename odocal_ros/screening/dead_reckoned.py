# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""
Fixes of a receiver that dead-reckons where it has no satellites, and jumps when it has them again.

Its own odometer and gyro make such fixes smooth: the change of their displacement from second to
second is what odometer and IMU predict, far better than elsewhere. The jump at the end is the sum
of its errors, so these fixes contain no information on the scale.
"""

from collections.abc import Callable

import numpy as np

from odocal_ros.data.arrays import Bools, Complexes, Floats
from odocal_ros.nav.gaps import MISSING_INTERVALS
from odocal_ros.reasons import Code, Reason

COMPARED_EVERY = 1.0     # s between the fixes that are compared: judgement
MOVED_LEAST = 1.0        # m in this time, judgement: displacements then have a direction
# judgement: smooth is a quarter of the median, or half of it where gyro and odometer add 3 cm
SMOOTH_LIMIT, FINE_SHARE, FINE_LIMIT = 0.25, 0.5, 0.03
# judgement: of so many seconds this share is smooth; of white noise three times in 10^8 (a
# quarter), or in 10^4 (half)
SMOOTH_ROWS, SMOOTH_SHARE = 10, 0.7
# medians and m: a jump. Judgement: white noise exceeds three medians once in 500 seconds, after a
# smooth section
JUMP_SIZE, SHORTEST_JUMP = 3.0, 0.5
SPANS_SAID = 3           # judgement: spans in a reason


def reckoned(t_fix: Floats, fixes_n: Floats, path: Floats, turned: Callable[[Floats], Floats],
             ) -> tuple[Bools, tuple[Reason, ...]]:
    """
    Return a mask of fixes that a receiver has reckoned, and FIXES_DEAD_RECKONED.

    t_fix : (k,) s.   fixes_n : (k, 3) m.   path : (k,) path length by the odometer, m, its scale
    good to 30 %.   turned : angle turned about the vertical by (m,) times, rad: (m,).
    """
    spans = _spans(t_fix, fixes_n[:, 0] + 1j * fixes_n[:, 1], path, turned)
    found = np.zeros(len(t_fix), bool)
    for begin, end, _ in spans:
        found |= (t_fix >= begin) & (t_fix <= end)
    if not spans:
        return found, ()
    said = ', '.join(f't = {begin:.0f} to {end:.0f} s (jump of {jump:.1f} m)'
                     for begin, end, jump in spans[:SPANS_SAID])
    more = f' and {len(spans) - SPANS_SAID} more' * (len(spans) > SPANS_SAID)
    return found, (Reason(Code.FIXES_DEAD_RECKONED, f'the receiver dead-reckoned at {said}{more}: '
                          f'{int(found.sum())} of {len(t_fix)} fixes not used'),)


def _spans(t: Floats, place: Complexes, path: Floats,
           turned: Callable[[Floats], Floats]) -> list[tuple[float, float, float]]:
    """Return begin and end of each span, s, and the jump after it, m."""
    if len(t) <= SMOOTH_ROWS:
        return []
    step = max(1, round(COMPARED_EVERY / float(np.median(np.diff(t)))))
    t, place, path = t[::step], place[::step], path[::step]
    dt, way, moved = np.diff(t), np.diff(path), np.diff(place)
    whole = (np.abs(way) > MOVED_LEAST) & (dt < MISSING_INTERVALS * np.median(dt))
    both = np.flatnonzero(whole[1:] & whole[:-1])
    if len(both) <= SMOOTH_ROWS:
        return []
    angle = np.diff(turned((t[1:] + t[:-1]) / 2))[both]
    off = np.abs(moved[both + 1] - moved[both] * np.exp(1j * angle) * way[both + 1] / way[both])
    usual = float(np.median(off))
    smooth = off < max(SMOOTH_LIMIT * usual, min(FINE_LIMIT, FINE_SHARE * usual))
    spans: list[tuple[float, float, float]] = []
    for k in np.flatnonzero(off > max(JUMP_SIZE * usual, SHORTEST_JUMP)):
        begin = float(t[both[_begin(smooth[:k])]])
        # the row after a jump is as far off
        if begin < t[both[k]] and (not spans or begin > spans[-1][1]):
            spans.append((begin, float(t[both[k] + 1]), float(off[k])))
    return spans


def _begin(smooth: Bools) -> int:
    """Return the first row of the smooth section that ends a series, its length without one."""
    begin = len(smooth)
    while begin >= SMOOTH_ROWS and smooth[begin - SMOOTH_ROWS:begin].mean() >= SMOOTH_SHARE:
        begin -= 1
    return begin if begin == len(smooth) else begin - SMOOTH_ROWS + 1 + int(
        np.argmax(smooth[begin - SMOOTH_ROWS + 1:]))
