# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Reversing that the odometer counts upwards: the direction of travel flips against the fixes.

The track is level: travel along a heading that is the integral of the gyro about the mean upward
axis. A three-dimensional attitude by gyros alone tilts within minutes, and its horizontal
directions are then wrong. The heading drifts too, but slowly. A reversal flips the direction by
half a turn from one piece of the drive to the next, and the fixes stay back by twice its length;
an error of the fixes that runs against the travel goes away again.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.calib.check import ONE_MOTION_RATIO
from odocal_ros.calib.drive import knots_of
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav.angles import arctan2, wrap
from odocal_ros.nav.statistics import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS

# rad: a direction that changes by more is taken to flip. Judgement: half a turn, less what noise
# and drift may take off
FLIP = np.deg2rad(135.0)
# s about a reversal, in which an error of the fixes is over. Judgement: multipath lasts as long
ERROR_LASTS = 60.0


class Pieces(NamedTuple):
    """
    Pieces of a drive between fixes, one after the other: (k,) each.

    t : s, the middle.   off : rad, direction of the track less course by the fixes.
    length : m, by the fixes.   stretch : length of the track over that, 1 usually.
    """

    t: Floats
    off: Floats
    length: Floats
    stretch: Floats


def level_track(way: Floats, turned: Floats) -> Floats:
    """
    Return the path of travel on level ground, but for a rotation: (n, 2) in units of travel.

    turned, way : (n,) arrays, turn about the upward axis, rad, and travel.
    """
    middle = (turned[1:] + turned[:-1]) / 2
    step = np.diff(way)[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1)
    out: Floats = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    return out


def pieces(track_2d: Floats, fixes_2d: Floats, t: Floats, sigma: float) -> Pieces:
    """
    Cut the drive into pieces long enough for a direction.

    track_2d, fixes_2d, t : (n, 2), (n, 2), (n,) at the fixes, any unit, m and s.   sigma : white
    noise of a fix, m.
    """
    # a direction is then good to sqrt(2) / 20 rad
    knots = np.array(knots_of(fixes_2d, max(10.0, 20 * sigma)), int)
    if len(knots) < 2:
        return Pieces(*(np.empty(0),) * 4)
    a, b = knots[:-1], knots[1:]
    track, fix = track_2d[b] - track_2d[a], fixes_2d[b] - fixes_2d[a]
    length, middle = np.hypot(*fix.T), (t[a] + t[b]) / 2
    stretch = np.hypot(*track.T) / length
    off = wrap(arctan2(*track.T[::-1]) - arctan2(*fix.T[::-1]))
    return Pieces(middle, off, length, stretch / (np.median(stretch) or 1.0))


def backwards(found: Pieces) -> Bools:
    """
    Return True for pieces that run backwards: (k,) bool.

    The offset of the heading is a random walk: its variance grows with the time between pieces,
    and its size is the median of what the offset changes by. What changes by half a turn, and by
    FAULT_SIGMAS of that walk, is a flip. Where the walk may reach a flip nothing is known of what
    follows; each part between such gaps has its own forward direction, in which most pieces run.

    While the fixes go back the counter continues: a piece on the spot, or in which fixes jump,
    has no direction.
    """
    back = np.zeros(len(found.t), bool)
    found = _without_bias(found)
    moves = np.flatnonzero((found.stretch > ONE_MOTION_RATIO[0])
                           & (found.stretch < ONE_MOTION_RATIO[1]))
    if len(moves) < 3:
        return back
    dt, step = np.maximum(np.diff(found.t[moves]), 1e-9), wrap(np.diff(found.off[moves]))
    usual = robust_sigma(step)
    sigma = usual * np.sqrt(np.maximum(dt / np.median(dt), 1.0))
    unknown = np.flatnonzero(FAULT_SIGMAS * sigma > FLIP) + 1
    state = np.cumsum(np.append(False, np.abs(step) > FLIP)) % 2 == 1
    for part in np.split(np.arange(len(moves)), unknown):
        flipped = state[part] != (np.mean(state[part]) > 0.5)
        for run in np.split(np.arange(len(part)), np.flatnonzero(np.diff(flipped)) + 1):
            if len(run) and flipped[run[0]] and _stays_back(
                    found, moves[part[run]], moves[part[~flipped]]):
                back[moves[part[run]]] = True
    return back


def _without_bias(found: Pieces) -> Pieces:
    """Return pieces without the remaining gyro bias, which turns all of them equally."""
    if len(found.t) < 2:
        return found
    rate = np.median(wrap(np.diff(found.off)) / np.diff(found.t))
    return found._replace(off=wrap(found.off - rate * found.t))


def _stays_back(found: Pieces, run: Ints, forward: Ints) -> bool:
    """
    Return True if the fixes stay behind after a run of pieces, as after a reversal.

    Against a heading that drifts each piece is held by that of the next one forwards.
    run, forward : indices of the pieces that may run backwards, and of those that do not.
    """
    t = found.t
    about = (t >= t[run[0]] - ERROR_LASTS) & (t <= t[run[-1]] + ERROR_LASTS)
    about[run] = False
    nearest = forward[np.argmin(np.abs(t[about][:, None] - t[forward]), axis=1)]
    ahead = found.length[about] * (
        np.cos(found.off[about] - found.off[nearest]) - found.stretch[about])
    # of twice the run, which the fixes lack, they make up all or nothing
    return bool(ahead.sum() < found.length[run].sum())


def against_travel(found: Pieces, signed: bool) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH where counts rise while the vehicle drives backwards."""
    back = backwards(found)
    if not back.any():
        return ()
    how = 'odometer.signed is false' if not signed else 'the counter does not count down'
    return (Reason(Code.TRACK_MISMATCH, f'in {int(back.sum())} of {len(back)} sections the track '
                   f'runs opposite to the fixes. Likely cause: the vehicle reversed and {how}',
                   Code.REVERSING_UNSIGNED.remedy),)
