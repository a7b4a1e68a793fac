# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead-reckoned track compared with all fixes: residuals, and errors by path length.

Residuals are track minus fixes. Their statistics are part of the result; they show whether the
stated sigmas of the fixes are too small, and whether the track is too far from the fixes.
"""

from collections.abc import Sequence

import numpy as np

from odocal_ros.calib.marks import MarkFix, Path, window_means
from odocal_ros.calib.result import PerDistance, TrackCheck
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import OUTLIER_SIGMAS, REMARK_SIGMAS

# smallest factor applied to stated fix sigmas. Statistical: by the median of 30 fixes, chance
# alone gives 1.25 instead of 1 once in 30 legs
MIN_NOISE_FACTOR = 1.25
SECTION_LENGTHS_M = 100.0, 500.0, 1000.0    # m, definition: as in KITTI's benchmark, for roads
SECTION_STARTS = 10     # definition: a section starts every tenth of the length, as in KITTI


def track_residuals(path: Path, anchor: MarkFix, fixes: tuple[Floats, Floats]) -> Floats:
    """
    Return dead-reckoned minus fixed positions, (n, 3) m.

    path : function of t (n,) to the antenna's path, (n, 3) m, up to a constant.   anchor : mark
    whose position the path is set to.   fixes : (t, position_n) within the leg.
    """
    t, position_n = fixes
    return anchor.position_n + path(t) - path(np.array(anchor.t)) - position_n


def track_statistics(residual: Floats, path_length: float) -> TrackCheck:
    """Return the statistics of (n, 3) residuals, m; path_length: of the leg, m."""
    distance = np.hypot(*residual.T[:2])      # horizontal
    return TrackCheck(float(np.sqrt((distance**2).mean())), float(distance.max()),
                      float(distance.mean()), float(distance[-1]),
                      float(100 * distance[-1] / path_length) if path_length else 0.0)


def fix_noise_factor(residual: Floats, covariance_n: Floats, drift: float,
                     marks: Sequence[MarkFix] = ()) -> Floats:
    """
    Return factors on the stated fix sigmas that match the residuals, east, north, up: (3,).

    residual : (n, 3) corrected track minus fixes, m; NaN up where no height is known.
    covariance_n : (n, 3, 3) stated, m^2.   drift : track error by gyro drift, m; subtracted in
    quadrature. Other track errors are not subtracted, so factors are too large rather than too
    small; below MIN_NOISE_FACTOR they are 1.   marks : start and stop mark, at which track and
    fix are equal. Their errors act in proportion to the path, on average a third of each
    variance; the factor applies to them as well.
    """
    stated = np.median(np.diagonal(covariance_n, axis1=1, axis2=2), axis=0)
    # east plus north: the square of a length is exponentially distributed, its median is ln 2
    # times its mean
    horizontal = np.median((residual[:, :2]**2).sum(axis=1)) / np.log(2)
    up = robust_sigma(residual[:, 2] - np.median(residual[:, 2]))**2
    observed_variance = np.array([horizontal, horizontal, up]) - drift**2
    stated_horizontal = stated[0] + stated[1] + sum(
        np.trace(mark.covariance_n[:2, :2]) for mark in marks) / 3
    stated_variance = np.array([stated_horizontal, stated_horizontal, stated[2]])
    factors = np.sqrt(np.maximum(np.nan_to_num(observed_variance), 0.0)
                      / np.maximum(stated_variance, 1e-12))
    return np.where(factors > MIN_NOISE_FACTOR, factors, 1.0)


def _distance_limit(sigma: float, path_length: float) -> float:
    """Return the limit of the distance between track and fixes, m."""
    # statistical: 4 sigma, once in 16 000; judgement: 0.2 %, for slip, suspension and road
    return 4.0 * sigma + 0.002 * path_length


def distance_reasons(check: TrackCheck, fix_sigma: float, drift: float,
                     path_length: float) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH if the track is too far from the fixes; as for ``bend_reasons``."""
    allowed = _distance_limit(np.hypot(np.sqrt(2) * fix_sigma, drift), path_length)
    if check.rms <= allowed:
        return ()
    return (Reason(Code.TRACK_MISMATCH, f'the calibrated track is {check.rms:.1f} m rms from the '
                   f'fixes; the limit is {allowed:.1f} m'),)


def bend_reasons(t: Floats, residual: Floats, chord_n: Floats, fix_sigma: float, drift: float,
                 path_length: float) -> tuple[Reason, ...]:
    """
    Return MODEL_MISMATCH if a track bends more than gyro drift and fix errors explain.

    Track and fixes are equal at both marks, which do not show a wrong turn between them. Means of
    residuals across the chord do; means along it show the size of slow fix errors.

    t, residual : (n,), (n, 3) times, s, and corrected track minus fixes, m.   chord_n : (3,) from
    mark to mark, m.   fix_sigma, drift : sigma of a fix, and possible track error by gyro drift,
    m.   path_length : of the leg, m.
    """
    x, y = chord_n[:2] / np.hypot(*chord_n[:2])
    windows = window_means(t, *(residual[:, :2] @ axis for axis in ((x, y), (-y, x))))
    if len(windows.rows) < 3:      # two windows show no bend
        return ()
    along, across = windows.means
    sigma = np.sqrt((along**2).mean() + fix_sigma**2 / np.median(windows.rows) + drift**2)
    allowed, deviation = _distance_limit(sigma, path_length), np.abs(across).max()
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
    # a difference of two fixes has four variances: two axes of two fixes
    variance = np.median((np.diff(horizontal, axis=0)**2).sum(axis=1)) / np.log(2) / 4
    sigma = max(fix_sigma, float(np.sqrt(variance)))
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(horizontal, ((2, 2), (0, 0)), 'edge'), 5, axis=0)
    deviation = np.hypot(*(horizontal - np.median(windows, axis=-1)).T)
    return deviation <= OUTLIER_SIGMAS * sigma, sigma


def compare_sections(path: Floats, before: Floats, after: Floats, configured: bool,
                     ) -> tuple[tuple[PerDistance, ...], tuple[Reason, ...]]:
    """
    Return the rms errors of two tracks over sections of the path, each set to its first fix.

    Also returns CHECK_WORSE if the second track is significantly farther from the fixes.

    path : (k,) path length at each fix, m.   before, after : (k, 3) track minus fixes, m, up to a
    constant, without and with calibration. The noise of the fixes is included.   configured : a
    nominal scale is set.
    """
    errors: list[PerDistance] = []
    reasons: list[Reason] = []
    for length in SECTION_LENGTHS_M:
        first, last = _section_ends(path, length)
        if not len(first):
            continue
        squares_before, squares_after = (
            ((residual[last] - residual[first])[:, :2]**2).sum(axis=1)
            for residual in (before, after))
        mean_before, mean_after = squares_before.mean(), squares_after.mean()
        rms_before, rms_after = float(np.sqrt(mean_before)), float(np.sqrt(mean_after))
        pieces = len(first) / SECTION_STARTS      # number of sections end to end
        errors.append(PerDistance(length, rms_before, rms_after, pieces))
        increase = squares_after - squares_before
        # fewer than three sections end to end have no known scatter; a tenth more is acceptable
        if pieces >= 3 and mean_after >= 1.1**2 * mean_before \
                and increase.mean() >= REMARK_SIGMAS * increase.std() / np.sqrt(pieces):
            before_text = 'with the configured values' if configured else 'without calibration'
            reasons.append(Reason(
                Code.CHECK_WORSE, f'calibration makes the track worse: {rms_after:.2g} m rms from '
                f'the fixes in sections of {length:g} m, {rms_before:.2g} m {before_text}'))
    return tuple(errors), tuple(reasons[:1])


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
