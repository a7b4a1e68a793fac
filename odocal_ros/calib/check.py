# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Dead-reckoned track compared with all fixes and by path length, before and after correction."""

from collections.abc import Iterator, Sequence

import numpy as np

from odocal_ros.calib.marks import MarkFix, Path, window_means
from odocal_ros.calib.result import PerDistance, TrackCheck
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav.statistics import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import OUTLIER_SIGMAS, REMARK_SIGMAS

# limits of path length, or turn, by the track relative to the fixes. Physical: errors of scale,
# skid or lean are smaller; fixes that only jump have any path length
ONE_MOTION_RATIO = 0.6, 1.6
# smallest factor applied to stated fix sigmas. Statistical: by the median of 30 fixes, chance
# alone gives 1.25 instead of 1 once in 30 legs
NOISIER_WORTH = 1.25
PIECE_LENGTHS = 100.0, 500.0, 1000.0    # m, definition: as in KITTI's benchmark, for roads
PIECE_STARTS = 10                       # definition: of pieces, on the length of one, as there


def track_residuals(path: Path, pin: MarkFix, fixes: tuple[Floats, Floats]) -> Floats:
    """
    Return dead-reckoned minus fixed positions, (n, 3) m.

    path : t (n,) to the antenna's path, (n, 3) m, up to a constant.   pin : mark whose position
    the path is set to.   fixes : (t, position_n) within the leg.
    """
    t, position_n = fixes
    return pin.position_n + path(t) - path(np.array(pin.t)) - position_n


def track_check(residual: Floats, distance: float) -> TrackCheck:
    """Return the statistics of horizontal residuals, m: the patent's (max, mean) and others."""
    d = np.hypot(*residual.T[:2])
    return TrackCheck(float(np.sqrt((d**2).mean())), float(d.max()), float(d.mean()),
                      float(d[-1]), float(100 * d[-1] / distance) if distance else 0.0)


def fix_noise_factor(residual: Floats, covariance_n: Floats, drift: float,
                     marks: Sequence[MarkFix] = ()) -> Floats:
    """
    Return the factors on stated fix sigmas by the residuals, east, north, up: (3,).

    residual : (n, 3) corrected track minus fixes, m; NaN up where no height is known.
    covariance_n : (n, 3, 3) stated, m^2.   drift : possible track error by gyro drift, m, whose
    square is subtracted. The rest may include other track errors, so the factors tend to be too
    large; below NOISIER_WORTH they are 1.   marks : the two that the track is pinned to. Their
    errors act in proportion to the path, on average a third of each variance; the factor applies
    to them as well.
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


def _distance_limit(sigma: float, distance: float) -> float:
    """Return the limit of the distance between track and fixes, m."""
    # once in 16 000 by chance; slip, suspension and road: judgement
    return 4.0 * sigma + 0.002 * distance


def mismatch(check: TrackCheck, fix_sigma: float, drift: float,
             distance: float) -> tuple[Reason, ...]:
    """Return TRACK_MISMATCH where the calibrated track is too far from the fixes."""
    allowed = _distance_limit(np.hypot(np.sqrt(2) * fix_sigma, drift), distance)
    if check.rms <= allowed:
        return ()
    return (Reason(Code.TRACK_MISMATCH, f'the calibrated track is {check.rms:.1f} m rms from the '
                   f'fixes; the limit is {allowed:.1f} m'),)


def bent(t: Floats, residual: Floats, chord_n: Floats, fix_sigma: float, drift: float,
         distance: float) -> tuple[Reason, ...]:
    """
    Return MODEL_MISMATCH if a pinned track bends more than gyro drift and fix errors explain.

    The ends alone do not show a false or missing turn between them. Means of the residuals over
    windows do, across the chord; the means along it show the size of slow fix errors.

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
    allowed, most = _distance_limit(sigma, distance), np.abs(across).max()
    if most <= allowed:
        return ()
    return (Reason(Code.MODEL_MISMATCH, f'the track deviates up to {most:.1f} m from the fixes; '
                   f'the limit is {allowed:.1f} m. Likely cause: gyro errors larger than its '
                   'grade, or invalid gyro values', 'Use method smoother, which also estimates '
                   'the gyro errors. Check for lost or invalid IMU messages, or copy the '
                   'recording again.'),)


def steady(residual: Floats, fix_sigma: float) -> tuple[Bools, float]:
    """
    Return a mask of fixes that are no outliers relative to their neighbours, (n,), and the noise.

    residual : (n, 2 or more) corrected track minus fixes, m; the track may have large errors.
    The noise is the sigma of a fix by differences of consecutive ones, m, at least fix_sigma.
    """
    level = residual[:, :2]
    jump = np.median((np.diff(level, axis=0)**2).sum(axis=1)) / np.log(2) / 4
    sigma = max(fix_sigma, float(np.sqrt(jump)))
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(level, ((2, 2), (0, 0)), 'edge'), 5, axis=0)
    off = np.hypot(*(level - np.median(windows, axis=-1)).T)
    return off <= OUTLIER_SIGMAS * sigma, sigma


def per_distance(path: Floats, before: Floats, after: Floats) -> tuple[PerDistance, ...]:
    """
    Return the rms errors of two tracks over pieces of the path, each set to the fix at its begin.

    path : (k,) path length at each fix, m.   before, after : (k, 3) track minus fixes, m, up to a
    constant. The noise of the fixes is included.
    """
    return tuple(PerDistance(length, float(np.sqrt(was.mean())), float(np.sqrt(now.mean())),
                             pieces)
                 for length, pieces, (was, now) in _lengths(path, before, after))


def _lengths(path: Floats, before: Floats,
             after: Floats) -> Iterator[tuple[float, float, list[Floats]]]:
    for length in PIECE_LENGTHS:
        a, b = _ends(path, length)
        if len(a):
            squares = [((x[b] - x[a])[:, :2]**2).sum(axis=1) for x in (before, after)]
            yield length, len(a) / PIECE_STARTS, squares


def _ends(path: Floats, length: float) -> tuple[Ints, Ints]:
    """Return first and last rows of pieces of a length, whose begins are a tenth of it apart."""
    begin = np.arange(path[0], path[-1] - length,
                      length / PIECE_STARTS) if len(path) else np.empty(0)
    a = np.searchsorted(path, begin)
    b = np.searchsorted(path, path[a] + length)
    whole = b < len(path)
    a, b = a[whole], b[whole]
    near = path[b] - path[a] <= 1.2 * length      # in longer ones fixes are missing
    return a[near], b[near]


def check_worse(path: Floats, before: Floats, after: Floats, configured: bool) -> list[Reason]:
    """
    Return CHECK_WORSE if the correction significantly increases the distance to the fixes.

    before, after, path : as for ``per_distance``.   configured : a nominal scale is configured.
    """
    for length, pieces, (was, now) in _lengths(path, before, after):
        more = now - was
        # fewer than three pieces end to end have no known scatter; a tenth more is acceptable
        if pieces < 3 or now.mean() < 1.1**2 * was.mean() \
                or more.mean() < REMARK_SIGMAS * more.std() / np.sqrt(pieces):
            continue
        return [Reason(Code.CHECK_WORSE, f'in sections of {length:g} m the calibrated track '
                       f'deviates {np.sqrt(now.mean()):.2g} m rms from the fixes, the '
                       + ('track as configured' if configured else 'uncalibrated track')
                       + f' {np.sqrt(was.mean()):.2g} m')]
    return []
