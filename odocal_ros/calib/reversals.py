# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Sections of a drive in which the odometer counts up while the vehicle reverses.

The direction of the dead-reckoned track is then wrong by half a turn. After the reversal, track
and fixes stay apart by twice the reversed length; after a fix error they come together again. The
track of this test is level: an attitude by gyros alone tilts within minutes.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.calib.drive import separated_fixes
from odocal_ros.data.arrays import Bools, Floats, Ints, runs
from odocal_ros.nav.rotations import arctan2, wrap
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS

# limits of path length by track over path length by fixes; also of turns. Physical: errors of
# scale, skid or lean are smaller; fixes that only jump have any path length
PLAUSIBLE_RATIO = 0.6, 1.6
# rad: a larger change of direction is a reversal. Judgement: half a turn, minus a margin for
# noise and drift
MIN_REVERSAL_TURN = np.deg2rad(135.0)
# s around a reversal, within which a fix error disappears. Judgement: duration of multipath
FIX_ERROR_DURATION = 60.0


class CourseSections(NamedTuple):
    """Consecutive sections of a drive, each from a fix to a later one: (k,)."""

    t: Floats              # s, the middle
    heading_error: Floats  # rad, direction of the track minus course by the fixes
    length: Floats         # m, by the fixes
    length_ratio: Floats   # length of the track over ``length``, median 1
    course: Floats         # rad, direction by the fixes


def cut_sections(track_2d: Floats, fixes_2d: Floats, t: Floats, sigma: float) -> CourseSections:
    """
    Return the drive in sections long enough for a direction.

    track_2d, fixes_2d, t : (n, 2), (n, 2), (n,) at the fixes, any unit, m and s.   sigma : white
    noise of a fix, m.
    """
    # the sigma of a direction is then sqrt(2) / 20 rad
    knots = np.array(separated_fixes(fixes_2d, max(10.0, 20 * sigma)), int)
    if len(knots) < 2:
        return CourseSections(*(np.empty(0),) * 5)
    track, fix = np.diff(track_2d[knots], axis=0), np.diff(fixes_2d[knots], axis=0)
    length, course = np.hypot(*fix.T), arctan2(*fix.T[::-1])
    ratio = np.hypot(*track.T) / length
    middle = (t[knots[:-1]] + t[knots[1:]]) / 2
    return CourseSections(middle, wrap(arctan2(*track.T[::-1]) - course), length,
                  ratio / (np.median(ratio) or 1.0), course)


def find_reversed(sections: CourseSections) -> Bools:
    """
    Return True for sections that are driven backwards: (k,) bool.

    The heading error is a random walk: its variance grows with the time between sections. The
    median of its changes gives its size. A section is opposite if its error is more than
    MIN_REVERSAL_TURN from the mean of earlier ones. Where FAULT_SIGMAS of the walk exceed it, the
    drive is divided; forward is the direction of most sections of each division.

    Sections whose path lengths by track and by fixes differ too much (turns on the spot, jumps of
    the fixes) have no direction.
    """
    is_reversed = np.zeros(len(sections.t), bool)
    heading_error = sections.heading_error
    if len(sections.t) > 1:        # without the remaining gyro bias, a constant rate of the error
        rate = np.median(wrap(np.diff(heading_error)) / np.diff(sections.t))
        sections = sections._replace(heading_error=wrap(heading_error - rate * sections.t))
    usable = np.flatnonzero((sections.length_ratio > PLAUSIBLE_RATIO[0])
                            & (sections.length_ratio < PLAUSIBLE_RATIO[1]))
    if len(usable) < 3:
        return is_reversed
    error = sections.heading_error[usable]
    dt = np.maximum(np.diff(sections.t[usable]), 1e-9)
    sigma = robust_sigma(wrap(np.diff(error))) * np.sqrt(np.maximum(dt / np.median(dt), 1.0))
    division_starts = np.flatnonzero(FAULT_SIGMAS * sigma > MIN_REVERSAL_TURN) + 1
    opposite = _is_opposite(error)
    for division in np.split(np.arange(len(usable)), division_starts):
        backward = opposite[division] != (np.mean(opposite[division]) > 0.5)
        for begin, end in runs(backward):
            candidates = usable[division[begin:end]]
            if _fixes_stay_behind(sections, candidates, usable[division[~backward]]):
                is_reversed[candidates] = True
    return is_reversed


def _is_opposite(heading_error: Floats) -> Bools:
    """Return True for angles, rad, opposite to the running mean of those before: (k,)."""
    mean, opposite = float(heading_error[0]), np.zeros(len(heading_error), bool)
    for k, angle in enumerate(heading_error.tolist()):
        opposite[k] = abs(wrap(angle - mean)) > MIN_REVERSAL_TURN
        mean += float(wrap(angle - mean - np.pi * opposite[k])) / 2
    return opposite


def _fixes_stay_behind(sections: CourseSections, candidates: Ints, forward: Ints) -> bool:
    """
    Return True if the fixes stay behind the track after some sections, as after a reversal.

    From FIX_ERROR_DURATION before to after them, the displacement of the fixes is then nearer to
    that of the track with these sections reversed; after a fix error, to that of the track.
    candidates, forward : indices of consecutive sections that may be reversed, and of forward
    ones.
    """
    t, error = sections.t, sections.heading_error
    nearby = np.flatnonzero((t >= t[candidates[0]] - FIX_ERROR_DURATION)
                            & (t <= t[candidates[-1]] + FIX_ERROR_DURATION))
    # the median heading error of forward sections: that of a single one contains a fix error
    forward_errors = error[forward[np.isin(forward, nearby)]]
    nearest_error = float(error[forward[np.argmin(np.abs(t[forward] - t[candidates[0]]))]])
    forward_error = nearest_error + (float(np.median(wrap(forward_errors - nearest_error)))
                                     if len(forward_errors) else 0.0)
    # displacements by track and by fixes, east + i north, m
    track = sections.length_ratio[nearby] * sections.length[nearby] * np.exp(
        1j * (sections.course[nearby] + error[nearby] - forward_error))
    fixes = sections.length[nearby] * np.exp(1j * sections.course[nearby])
    difference = np.sum(fixes) - track.sum()
    reversal = -2 * track[np.isin(nearby, candidates)].sum()      # effect on the displacement
    return bool(abs(difference - reversal) < abs(difference))


def reversal_reasons(sections: CourseSections, signed: bool) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH if counts increase while the vehicle drives backwards."""
    is_reversed = find_reversed(sections)
    cause = 'the counter does not count down' if signed else 'odometer.signed is false'
    return (Reason(Code.TRACK_MISMATCH, f'in {int(is_reversed.sum())} of {len(is_reversed)} '
                   'sections the track runs opposite to the fixes. Likely cause: the vehicle '
                   f'reversed and {cause}', Code.REVERSING_UNSIGNED.remedy),) \
        if is_reversed.any() else ()
