# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fix errors that are constant during a mark: observable along the leg, but not at the mark."""

import numpy as np

from odocal_ros.calib.marks import MarkFix, standing_at
from odocal_ros.data.arrays import Floats, Ints

# s, window in which white errors average down and slow ones do not. Physical: slow errors of
# receivers last a minute and more
SLOW_WINDOW = 20.0


def window_means(t: Floats, *columns: Floats) -> tuple[Ints, Ints, list[Floats]]:
    """
    Return the means of columns over windows of SLOW_WINDOW with enough rows, and their counts.

    t : (n,) s; windows begin at the first.   columns : (n,) each.   Returns (k,) numbers of rows
    in a window, (k,) window numbers, and a list of (k,) means.
    """
    window = ((t - t[0]) / SLOW_WINDOW).astype(int)
    count = np.bincount(window)
    full = np.flatnonzero(count >= max(5, 0.5 * count.max()))
    return count[full], full, [np.bincount(window, x)[full] / count[full] for x in columns]


def slow_variance(t: Floats, along: Floats, place: Floats, variance: Floats,
                  drift: float) -> tuple[float, float]:
    """
    Return the variance of slow fix errors over SLOW_WINDOW, m^2, and their correlation time, s.

    It is by means of the residuals over windows, in which white errors average down. A slow part
    of a fifth of the variance is not observable in the scatter at a mark, but dominates its mean.
    Only residuals along the chord are used, because gyro drift acts across it; a straight line
    over the path, the effect of the errors of the two marks, is removed.

    t, along, place : (n,) times, s, corrected track minus fixes along the chord, m, and position
    along it, m.   variance : (n,) stated, m^2.   drift : possible track error by gyro drift along
    the chord, m, which is subtracted.
    """
    count, number, (means, places) = window_means(t, along, place)
    if len(count) < 5:      # after mean and slope, a variance by five has a sigma of 80 %
        return 0.0, np.inf
    means, places = means - means.mean(), places - places.mean()
    means = means - places * (places @ means) / max(places @ places, 1e-9)
    free = len(count) - 2
    jump = np.median(np.diff(along)**2) / 0.4549 / 2      # median of a squared normal deviate
    white = min(jump, np.median(variance)) / np.median(count)
    seen = (means**2).sum() / free - drift**2
    # within three sigmas of the mean square by white errors alone
    if seen <= white * (1 + 3 * np.sqrt(2 / free)):
        return 0.0, np.inf
    next_to = (means[1:] * means[:-1])[np.diff(number) == 1]
    correlated = (next_to.mean() - drift**2) / (seen - white) if len(next_to) else 1.0
    return float(seen - white), _time_constant(correlated)


def _time_constant(correlated: float) -> float:
    """Return the time constant, s, by the correlation of adjacent means of SLOW_WINDOW."""
    times = np.geomspace(2.0, 2000.0, 100)      # s, that such a window can determine
    x = SLOW_WINDOW / times
    correlation = (1 - np.exp(-x))**2 / (2 * (x - 1 + np.exp(-x)))
    return float(np.interp(correlated, correlation, times))


def slow_share(seconds: float, tau: float) -> float:
    """Return the variance of the mean of slow errors over a time, over that of SLOW_WINDOW."""
    share = [2 * (x - 1 + np.exp(-x)) / x**2 if x > 1e-4 else 1.0
             for x in (seconds / tau, SLOW_WINDOW / tau)]       # of a Gauss-Markov process
    return float(share[0] / share[1])


def with_slow_errors(mark: MarkFix, slow: float, tau: float, span: tuple[float, float] | None,
                     stated: float, up_ratio: float) -> MarkFix:
    """
    Return a mark with at least the variance of the slow fix errors.

    The variance by a mark's own fixes is as reliable as that by the leg, if it includes slow
    errors: it is increased only if it is that of white errors, or if the leg has clearly more.

    mark : with the variance of its own fixes.   slow, tau : as slow_variance returns them.   span
    : (begin, end) or None the standstill at the mark, s; None in motion.   stated : variance of
    one fix, m^2.   up_ratio : variance up over that of a horizontal axis.
    """
    begin, end = span or (mark.t, mark.t)
    floor = slow * slow_share(end - begin, tau)
    own = (mark.covariance_n[0, 0] + mark.covariance_n[1, 1]) / 2
    unclear = 2.0       # ratio of variances: below, neither of two estimates is better
    took_for_white = own * mark.used < unclear * stated
    if took_for_white or floor > unclear * own:
        return mark.at_least(floor, up_ratio)
    return mark


def marks_with_slow_errors(marks: tuple[MarkFix, MarkFix], spans: Floats, t: Floats, way_n: Floats,
                           chord_n: Floats, residual: Floats, covariance_n: Floats,
                           drift_n: Floats) -> tuple[MarkFix, MarkFix]:
    """
    Return both marks of a leg with at least the variance of its slow fix errors.

    marks : (MarkFix, MarkFix) with the variance of their own fixes.   spans : (k, 2) standstills,
    s.   t, way_n, residual, covariance_n : (n,), (n, 3), (n, 3), (n, 3, 3) times of the fixes, s,
    corrected track there, m, track minus fix, m, and stated covariance, m^2.   chord_n : (3,) from
    mark to mark, m.   drift_n : (3, k) possible track error by gyro drift, m.
    """
    along = chord_n[:2] / np.hypot(*chord_n[:2])
    stated = np.einsum('nij,i,j->n', covariance_n[:, :2, :2], along, along)
    slow, tau = slow_variance(t, residual[:, :2] @ along, way_n[:, :2] @ along, stated,
                              float(np.linalg.norm(along @ drift_n[:2])))
    up_ratio = np.median(covariance_n[:, 2, 2] / stated)
    start, end = (with_slow_errors(mark, slow, tau, standing_at(mark.t, spans), np.median(stated),
                                   up_ratio) for mark in marks)
    return start, end
