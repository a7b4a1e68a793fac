# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead-reckoned track compared with all fixes: residuals, errors by path length, and reversing.

Residuals are track minus fixes. If an odometer counts up while the vehicle reverses, the direction
of the track is wrong by half a turn. After the reversal, track and fixes stay apart by twice the
reversed length; after a fix error they come together again. The track of this test is level: an
attitude by gyros alone tilts within minutes.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.drive import separated_fixes
from odocal_ros.calib.marks import MarkFix, Path, window_means
from odocal_ros.calib.result import PerDistance, TrackCheck
from odocal_ros.data.arrays import Bools, Floats, Ints, runs
from odocal_ros.nav.rotations import arctan2, wrap
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS, OUTLIER_SIGMAS, REMARK_SIGMAS

# limits of path length by track over path length by fixes; also of turns. Physical: errors of
# scale, skid or lean are smaller; fixes that only jump have any path length
PLAUSIBLE_RATIO = 0.6, 1.6
# smallest factor applied to stated fix sigmas. Statistical: by the median of 30 fixes, chance
# alone gives 1.25 instead of 1 once in 30 legs
MIN_NOISE_FACTOR = 1.25
SECTION_LENGTHS_M = 100.0, 500.0, 1000.0    # m, definition: as in KITTI's benchmark, for roads
SECTION_STARTS = 10     # definition: a section starts every tenth of the length, as in KITTI
# rad: a larger change of direction is a reversal. Judgement: half a turn, minus a margin for
# noise and drift
MIN_REVERSAL_TURN = np.deg2rad(135.0)
# s around a reversal, within which a fix error disappears. Judgement: duration of multipath
FIX_ERROR_DURATION = 60.0


def track_residuals(path: Path, anchor: MarkFix, fixes: tuple[Floats, Floats]) -> Floats:
    """
    Return dead-reckoned minus fixed positions, (n, 3) m.

    path : function of t (n,) to the antenna's path, (n, 3) m, up to a constant.   anchor : mark
    whose position the path is set to.   fixes : (t, position_n) within the leg.
    """
    t, position_n = fixes
    return anchor.position_n + path(t) - path(np.array(anchor.t)) - position_n


def track_statistics(residual: Floats, distance: float) -> TrackCheck:
    """Return the statistics of (n, 3) residuals, m; distance: path length of the leg, m."""
    d = np.hypot(*residual.T[:2])      # horizontal
    return TrackCheck(float(np.sqrt((d**2).mean())), float(d.max()), float(d.mean()),
                      float(d[-1]), float(100 * d[-1] / distance) if distance else 0.0)


def fix_noise_factor(residual: Floats, covariance_n: Floats, drift: float,
                     marks: Sequence[MarkFix] = ()) -> Floats:
    """
    Return the factors on stated fix sigmas by the residuals, east, north, up: (3,).

    residual : (n, 3) corrected track minus fixes, m; NaN up where no height is known.
    covariance_n : (n, 3, 3) stated, m^2.   drift : track error by gyro drift, m; subtracted in
    quadrature. Other track errors are not subtracted, so factors are too large rather than too
    small; below MIN_NOISE_FACTOR they are 1.   marks : start and stop mark, at which track and
    fix are equal. Their errors act in proportion to the path, on average a third of each
    variance; the factor applies to them as well.
    """
    stated = np.median(np.diagonal(covariance_n, axis1=1, axis2=2), axis=0)
    # east plus north, whose squared length is exponentially distributed
    horizontal = np.median((residual[:, :2]**2).sum(axis=1)) / np.log(2)
    up = robust_sigma(residual[:, 2] - np.median(residual[:, 2]))**2
    observed_variance = np.array([horizontal, horizontal, up]) - drift**2
    stated_horizontal = stated[0] + stated[1] + sum(
        np.trace(mark.covariance_n[:2, :2]) for mark in marks) / 3
    stated_variance = np.array([stated_horizontal, stated_horizontal, stated[2]])
    factors = np.sqrt(np.maximum(np.nan_to_num(observed_variance), 0.0)
                      / np.maximum(stated_variance, 1e-12))
    return np.where(factors > MIN_NOISE_FACTOR, factors, 1.0)


def _distance_limit(sigma: float, distance: float) -> float:
    """Return the limit of the distance between track and fixes, m."""
    # once in 16 000 by chance; slip, suspension and road: judgement
    return 4.0 * sigma + 0.002 * distance


def distance_reasons(check: TrackCheck, fix_sigma: float, drift: float,
                     distance: float) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH where the calibrated track is too far from the fixes."""
    allowed = _distance_limit(np.hypot(np.sqrt(2) * fix_sigma, drift), distance)
    if check.rms <= allowed:
        return ()
    return (Reason(Code.TRACK_MISMATCH, f'the calibrated track is {check.rms:.1f} m rms from the '
                   f'fixes; the limit is {allowed:.1f} m'),)


def bend_reasons(t: Floats, residual: Floats, chord_n: Floats, fix_sigma: float, drift: float,
                 distance: float) -> tuple[Reason, ...]:
    """
    Return MODEL_MISMATCH if a track bends more than gyro drift and fix errors explain.

    Track and fixes are equal at both marks, which do not show a wrong turn between them. Means of
    residuals across the chord do; means along it show the size of slow fix errors.

    t, residual : (n,), (n, 3) times, s, and corrected track minus fixes, m.   chord_n : (3,) from
    mark to mark, m.   fix_sigma, drift : sigma of a fix, and possible track error by gyro drift,
    m.   distance : path length of the leg, m.
    """
    x, y = chord_n[:2] / np.hypot(*chord_n[:2])
    count, _, (along, across) = window_means(t, *(residual[:, :2] @ axis
                                                  for axis in ((x, y), (-y, x))))
    if len(count) < 3:      # two windows show no bend
        return ()
    sigma = np.sqrt((along**2).mean() + fix_sigma**2 / np.median(count) + drift**2)
    allowed, deviation = _distance_limit(sigma, distance), np.abs(across).max()
    if deviation <= allowed:
        return ()
    return (Reason(Code.MODEL_MISMATCH, f'the track deviates up to {deviation:.1f} m from the '
                   f'fixes; the limit is {allowed:.1f} m. Likely cause: gyro errors larger than '
                   'its grade, or invalid gyro values', 'Use method smoother, which also '
                   'estimates the gyro errors. If IMU messages are lost or invalid, copy the '
                   'recording again.'),)


def find_inliers(residual: Floats, fix_sigma: float) -> tuple[Bools, float]:
    """
    Return a mask of fixes that are no outliers relative to their neighbours, (n,), and the noise.

    residual : (n, 2 or more) corrected track minus fixes, m; the track may have large errors.
    The noise is the sigma of a fix by differences of consecutive ones, m, at least fix_sigma.
    """
    horizontal = residual[:, :2]
    variance = np.median((np.diff(horizontal, axis=0)**2).sum(axis=1)) / np.log(2) / 4
    sigma = max(fix_sigma, float(np.sqrt(variance)))
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(horizontal, ((2, 2), (0, 0)), 'edge'), 5, axis=0)
    deviation = np.hypot(*(horizontal - np.median(windows, axis=-1)).T)
    return deviation <= OUTLIER_SIGMAS * sigma, sigma


def errors_per_distance(path: Floats, before: Floats, after: Floats) -> tuple[PerDistance, ...]:
    """
    Return the rms errors of two tracks over sections of the path, each set to its first fix.

    path : (k,) path length at each fix, m.   before, after : (k, 3) track minus fixes, m, up to a
    constant. The noise of the fixes is included.
    """
    return tuple(PerDistance(length, float(np.sqrt(was.mean())), float(np.sqrt(now.mean())), count)
                 for length, count, (was, now) in _squared_errors(path, before, after))


def _squared_errors(path: Floats, before: Floats,
                    after: Floats) -> Iterator[tuple[float, float, list[Floats]]]:
    """Yield section length, path over length, and squared errors before and after, (p,) m^2."""
    for length in SECTION_LENGTHS_M:
        first, last = _section_ends(path, length)
        if len(first):
            squares = [((residual[last] - residual[first])[:, :2]**2).sum(axis=1)
                       for residual in (before, after)]
            yield length, len(first) / SECTION_STARTS, squares


def _section_ends(path: Floats, length: float) -> tuple[Ints, Ints]:
    """Return first and last rows of sections, which begin every tenth of their length."""
    begin = np.arange(path[0], path[-1] - length,
                      length / SECTION_STARTS) if len(path) else np.empty(0)
    first = np.searchsorted(path, begin)
    last = np.searchsorted(path, path[first] + length)
    is_complete = last < len(path)
    first, last = first[is_complete], last[is_complete]
    has_fixes = path[last] - path[first] <= 1.2 * length      # in longer ones fixes are missing
    return first[has_fixes], last[has_fixes]


def worse_check_reasons(path: Floats, before: Floats, after: Floats,
                        configured: bool) -> list[Reason]:
    """
    Return CHECK_WORSE if the correction significantly increases the distance to the fixes.

    path, before, after : as for ``errors_per_distance``.   configured : a nominal scale is set.
    """
    for length, count, (was, now) in _squared_errors(path, before, after):
        increase = now - was
        # fewer than three sections end to end have no known scatter; a tenth more is acceptable
        if count >= 3 and now.mean() >= 1.1**2 * was.mean() \
                and increase.mean() >= REMARK_SIGMAS * increase.std() / np.sqrt(count):
            before_text = 'with the configured values' if configured else 'without calibration'
            return [Reason(Code.CHECK_WORSE, 'calibration makes the track worse: '
                           f'{np.sqrt(now.mean()):.2g} m rms from the fixes in sections of '
                           f'{length:g} m, {np.sqrt(was.mean()):.2g} m {before_text}')]
    return []


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
    moves = np.flatnonzero((sections.length_ratio > PLAUSIBLE_RATIO[0])
                           & (sections.length_ratio < PLAUSIBLE_RATIO[1]))
    if len(moves) < 3:
        return is_reversed
    error = sections.heading_error[moves]
    dt = np.maximum(np.diff(sections.t[moves]), 1e-9)
    sigma = robust_sigma(wrap(np.diff(error))) * np.sqrt(np.maximum(dt / np.median(dt), 1.0))
    first_rows = np.flatnonzero(FAULT_SIGMAS * sigma > MIN_REVERSAL_TURN) + 1
    opposite = _is_opposite(error)
    for division in np.split(np.arange(len(moves)), first_rows):
        backward = opposite[division] != (np.mean(opposite[division]) > 0.5)
        for begin, end in runs(backward):
            tested = moves[division[begin:end]]
            if _fixes_stay_behind(sections, tested, moves[division[~backward]]):
                is_reversed[tested] = True
    return is_reversed


def _is_opposite(heading_error: Floats) -> Bools:
    """Return True for angles, rad, opposite to the running mean of those before: (k,)."""
    mean, opposite = float(heading_error[0]), np.zeros(len(heading_error), bool)
    for k, angle in enumerate(heading_error.tolist()):
        opposite[k] = abs(wrap(angle - mean)) > MIN_REVERSAL_TURN
        mean += float(wrap(angle - mean - np.pi * opposite[k])) / 2
    return opposite


def _fixes_stay_behind(sections: CourseSections, tested: Ints, forward: Ints) -> bool:
    """
    Return True if the fixes stay behind the track after some sections, as after a reversal.

    From FIX_ERROR_DURATION before to after them, the displacement of the fixes is then nearer to
    that of the track with these sections reversed; after a fix error, to that of the track.
    tested, forward : indices of consecutive sections that may be reversed, and of forward ones.
    """
    t, error = sections.t, sections.heading_error
    nearby = np.flatnonzero((t >= t[tested[0]] - FIX_ERROR_DURATION)
                            & (t <= t[tested[-1]] + FIX_ERROR_DURATION))
    # the median heading error of forward sections: that of a single one contains a fix error
    forward_errors = error[forward[np.isin(forward, nearby)]]
    nearest = float(error[forward[np.argmin(np.abs(t[forward] - t[tested[0]]))]])
    usual = nearest + (float(np.median(wrap(forward_errors - nearest)))
                       if len(forward_errors) else 0.0)
    track = sections.length_ratio[nearby] * sections.length[nearby] * np.exp(
        1j * (sections.course[nearby] + error[nearby] - usual))
    behind = np.sum(sections.length[nearby] * np.exp(1j * sections.course[nearby])) - track.sum()
    return bool(abs(behind + 2 * track[np.isin(nearby, tested)].sum()) < abs(behind))


def reversal_reasons(sections: CourseSections, signed: bool) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH if counts increase while the vehicle drives backwards."""
    is_reversed = find_reversed(sections)
    cause = 'the counter does not count down' if signed else 'odometer.signed is false'
    return (Reason(Code.TRACK_MISMATCH, f'in {int(is_reversed.sum())} of {len(is_reversed)} '
                   'sections the track runs opposite to the fixes. Likely cause: the vehicle '
                   f'reversed and {cause}', Code.REVERSING_UNSIGNED.remedy),) \
        if is_reversed.any() else ()
