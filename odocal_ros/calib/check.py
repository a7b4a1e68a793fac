# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The check: dead reckoning against every fix, before and after the correction; and sanity."""

from collections.abc import Sequence

import numpy as np

from odocal_ros.calib.marks import MarkFix, Path
from odocal_ros.calib.result import TrackCheck
from odocal_ros.calib.slow_errors import window_means
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.statistics import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import OUTLIER_SIGMAS

# ratio of two measures of one motion, ways or turns, by track and by fixes. Physical: no error of
# scale, skid or lean is so large; fixes that only jump go as far as they like
ONE_MOTION_RATIO = 0.6, 1.6
# factor on stated fix sigmas below which they stand. Statistical: by the median of 30 fixes chance
# alone makes 1.25 of 1 once in 30 legs
NOISIER_WORTH = 1.25


def stray(path: Path, pin: MarkFix, fixes: tuple[Floats, Floats]) -> Floats:
    """
    Return dead-reckoned minus fixed positions, (n, 3) m.

    path : t (n,) to the antenna's path, (n, 3) m, but for a constant.   pin : where the path is
    pinned.   fixes : (t, position_n) within the leg.
    """
    t, position_n = fixes
    return pin.position_n + path(t) - path(np.array(pin.t)) - position_n


def track_check(residual: Floats, distance: float) -> TrackCheck:
    """Return the patent's criteria (max, mean) and more of the residuals, m."""
    d = np.hypot(*residual.T[:2])
    return TrackCheck(float(np.sqrt((d**2).mean())), float(d.max()), float(d.mean()),
                      float(d[-1]), float(100 * d[-1] / distance) if distance else 0.0)


def fix_noise_factor(residual: Floats, covariance_n: Floats, drift: float,
                     marks: Sequence[MarkFix] = ()) -> Floats:
    """
    Return the factors on stated fix sigmas that residuals ask for, east, north, up: (3,).

    residual : (n, 3) corrected track less fixes, m; NaN up where no height is known.
    covariance_n : (n, 3, 3) as stated, m^2.   drift : what the gyros may have bent the track by,
    m: taken out of the residuals. What is left may still hold errors of the track, so this errs on
    the wide side; below NOISIER_WORTH the stated sigmas stand.   marks : the two that the track is
    pinned to: it has their errors, in proportion to the path a third of the variance of each, and
    the factor is theirs too.
    """
    stated = np.median(np.diagonal(covariance_n, axis1=1, axis2=2), axis=0)
    level2 = np.median((residual[:, :2]**2).sum(axis=1)) / np.log(2)     # mean of an exponential
    rise = residual[:, 2] - np.median(residual[:, 2])
    up2 = robust_sigma(rise)**2
    seen = np.array([level2, level2, up2]) - drift**2
    level = stated[0] + stated[1] + sum(np.trace(m.covariance_n[:2, :2]) for m in marks) / 3
    asked = np.array([level, level, stated[2]])
    factors = np.sqrt(np.maximum(np.nan_to_num(seen), 0.0) / np.maximum(asked, 1e-12))
    return np.where(factors > NOISIER_WORTH, factors, 1.0)


def _believable(sigma: float, distance: float) -> float:
    """
    Return the limit of the distance between track and fixes, m.

    Four sigmas (once in 16 000 by chance), and 0.2 % of the distance for slip, suspension and road
    (judgement).
    """
    return 4.0 * sigma + 0.002 * distance


def mismatch(check: TrackCheck, fix_sigma: float, drift: float,
             distance: float) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH where the corrected track differs from the fixes beyond its sigmas."""
    allowed = _believable(np.hypot(np.sqrt(2) * fix_sigma, drift), distance)
    if check.rms <= allowed:
        return ()
    return (Reason(Code.TRACK_MISMATCH, f'the corrected track is {check.rms:.1f} m rms from the '
                   f'fixes; the limit is {allowed:.1f} m'),)


def bent(t: Floats, residual: Floats, chord_n: Floats, fix_sigma: float, drift: float,
         distance: float) -> tuple[Reason, ...]:
    """
    Return MODEL_MISMATCH where a pinned track bends as neither its gyros nor the fixes would.

    The ends alone show neither a false nor a missing turn in between.
    Means over windows show it, across the chord; how far slow errors of the fixes may take them
    is what they do along it.

    t, residual : (n,), (n, 3) times, s, and corrected track less fixes, m.   chord_n : (3,) from
    mark to mark, m.   fix_sigma, drift : of a fix, and what the gyros may have bent the track by,
    m.   distance : of the leg, m.
    """
    x, y = chord_n[:2] / np.hypot(*chord_n[:2])
    count, _, (along, across) = window_means(t, *(residual[:, :2] @ axis
                                                  for axis in ((x, y), (-y, x))))
    if len(count) < 3:      # two windows have no bend between them
        return ()
    sigma = np.sqrt((along**2).mean() + fix_sigma**2 / np.median(count) + drift**2)
    allowed, most = _believable(sigma, distance), np.abs(across).max()
    if most <= allowed:
        return ()
    return (Reason(Code.MODEL_MISMATCH, f'the track deviates up to {most:.1f} m from the fixes; '
                   f'the limit is {allowed:.1f} m. Likely cause: gyro errors larger than its '
                   'grade, or invalid gyro values', 'Use method smoother, which also estimates '
                   'the gyro errors. Check for lost or invalid IMU messages, or copy the '
                   'recording again.'),)


def steady(residual: Floats, fix_sigma: float) -> tuple[Bools, float]:
    """
    Return the fixes that are no outliers beside their neighbours, and their noise.

    residual : (n, 2 or more) corrected track less fixes, m, whatever is wrong with the track.

    Returns
    -------
    (n,) bool, and the sigma of a fix against the next, m, no less than fix_sigma.

    """
    level = residual[:, :2]
    jump = np.median((np.diff(level, axis=0)**2).sum(axis=1)) / np.log(2) / 4
    sigma = max(fix_sigma, float(np.sqrt(jump)))
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(level, ((2, 2), (0, 0)), 'edge'), 5, axis=0)
    off = np.hypot(*(level - np.median(windows, axis=-1)).T)
    return off <= OUTLIER_SIGMAS * sigma, sigma
