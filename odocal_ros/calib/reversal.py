# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of reversing with an odometer that counts upwards: the track runs opposite to the fixes.

The track is level: travel along a heading that is the integral of the gyro about the mean upward
axis. A three-dimensional attitude by gyros alone tilts within minutes, and its horizontal
directions are then wrong. The heading drifts too, but slowly. A reversal flips the direction by
half a turn from one piece of the drive to the next, and the fixes remain behind the track by twice
its length; a fix error opposite to the travel disappears again.
"""

import math
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.check import ONE_MOTION_RATIO
from odocal_ros.calib.drive import knots_of
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav.rotations import arctan2, wrap
from odocal_ros.nav.statistics import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS

# rad: a larger change of direction is a flip. Judgement: half a turn, minus a margin for noise
# and drift
FLIP = np.deg2rad(135.0)
# s around a reversal, within which a fix error disappears. Judgement: duration of multipath
ERROR_LASTS = 60.0


class Pieces(NamedTuple):
    """Pieces of a drive between fixes, one after the other: (k,) each."""

    t: Floats        # s, the middle
    off: Floats      # rad, direction of the track minus course by the fixes
    length: Floats   # m, by the fixes
    stretch: Floats  # length of the track over ``length``, median 1
    course: Floats   # rad, direction by the fixes


def level_track(travel: Floats, turned: Floats) -> Floats:
    """Return the level path of travel, (n, 2) in its units; turned : (n,) rad about up."""
    middle = (turned[1:] + turned[:-1]) / 2
    step = np.diff(travel)[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])


def pieces(track_2d: Floats, fixes_2d: Floats, t: Floats, sigma: float) -> Pieces:
    """
    Cut the drive into pieces long enough for a direction.

    track_2d, fixes_2d, t : (n, 2), (n, 2), (n,) at the fixes, any unit, m and s.   sigma : white
    noise of a fix, m.
    """
    # the sigma of a direction is then sqrt(2) / 20 rad
    knots = np.array(knots_of(fixes_2d, max(10.0, 20 * sigma)), int)
    if len(knots) < 2:
        return Pieces(*(np.empty(0),) * 5)
    a, b = knots[:-1], knots[1:]
    track, fix = track_2d[b] - track_2d[a], fixes_2d[b] - fixes_2d[a]
    length, middle = np.hypot(*fix.T), (t[a] + t[b]) / 2
    stretch = np.hypot(*track.T) / length
    course = arctan2(*fix.T[::-1])
    off = wrap(arctan2(*track.T[::-1]) - course)
    return Pieces(middle, off, length, stretch / (np.median(stretch) or 1.0), course)


def backwards(found: Pieces) -> Bools:
    """
    Return True for pieces that are driven backwards: (k,) bool.

    The heading offset is a random walk: its variance grows with the time between pieces, and its
    size is by the median of its changes. A piece beyond FLIP from the mean of those before is
    opposite to them. Where FAULT_SIGMAS of the walk exceed FLIP, the drive is divided; each part
    has its own forward direction, that of most of its pieces.

    A piece whose path length by track and by fixes differs too much, as on the spot or with a
    jump of the fixes, has no direction.
    """
    back = np.zeros(len(found.t), bool)
    if len(found.t) > 1:        # without the remaining gyro bias, a constant rate of the offset
        rate = np.median(wrap(np.diff(found.off)) / np.diff(found.t))
        found = found._replace(off=wrap(found.off - rate * found.t))
    moves = np.flatnonzero((found.stretch > ONE_MOTION_RATIO[0])
                           & (found.stretch < ONE_MOTION_RATIO[1]))
    if len(moves) < 3:
        return back
    dt, step = np.maximum(np.diff(found.t[moves]), 1e-9), wrap(np.diff(found.off[moves]))
    usual = robust_sigma(step)
    sigma = usual * np.sqrt(np.maximum(dt / np.median(dt), 1.0))
    unknown = np.flatnonzero(FAULT_SIGMAS * sigma > FLIP) + 1
    state = _opposite(found.off[moves])
    for part in np.split(np.arange(len(moves)), unknown):
        flipped = state[part] != (np.mean(state[part]) > 0.5)
        for run in np.split(np.arange(len(part)), np.flatnonzero(np.diff(flipped)) + 1):
            if len(run) and flipped[run[0]] and _stays_back(
                    found, moves[part[run]], moves[part[~flipped]]):
                back[moves[part[run]]] = True
    return back


def _opposite(off: Floats) -> Bools:
    """Return True for offsets, rad, opposite to the mean of those before, which follows: (k,)."""
    mean, out = float(off[0]), np.zeros(len(off), bool)
    for k, angle in enumerate(off.tolist()):
        out[k] = abs(wrap(angle - mean)) > FLIP
        mean += float(wrap(angle - mean - math.pi * out[k])) / 2
    return out


def _stays_back(found: Pieces, run: Ints, forward: Ints) -> bool:
    """
    Return True if the fixes stay behind after a run of pieces, as after a reversal.

    Over ERROR_LASTS to each side, the displacement of the fixes is then nearer to that of the
    track with the run reversed; after a fix error, which disappears, to that of the track.
    """
    t = found.t
    about = np.flatnonzero((t >= t[run[0]] - ERROR_LASTS) & (t <= t[run[-1]] + ERROR_LASTS))
    # the heading by most forward pieces: that of single ones contains the error
    near = found.off[forward[np.isin(forward, about)]]
    base = float(found.off[forward[np.argmin(np.abs(t[forward] - t[run[0]]))]])
    usual = base + (float(np.median(wrap(near - base))) if len(near) else 0.0)
    track = found.stretch[about] * found.length[about] * np.exp(
        1j * (found.course[about] + found.off[about] - usual))
    off = np.sum(found.length[about] * np.exp(1j * found.course[about])) - track.sum()
    return bool(abs(off + 2 * track[np.isin(about, run)].sum()) < abs(off))


def against_travel(found: Pieces, signed: bool) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH if counts increase while the vehicle drives backwards."""
    back = backwards(found)
    if not back.any():
        return ()
    how = 'odometer.signed is false' if not signed else 'the counter does not count down'
    return (Reason(Code.TRACK_MISMATCH, f'in {int(back.sum())} of {len(back)} sections the track '
                   f'runs opposite to the fixes. Likely cause: the vehicle reversed and {how}',
                   Code.REVERSING_UNSIGNED.remedy),)
