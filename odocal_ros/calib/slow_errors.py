# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fix errors that are constant over a mark: observable along the leg, but not at the mark."""

import numpy as np

from odocal_ros.calib.marks import MarkFix, standing_at
from odocal_ros.data.arrays import Floats, Ints

# s, window in which white errors average down and slow ones do not. Physical: those of receivers
# stay for a minute and more
SLOW_WINDOW = 20.0


def window_means(t: Floats, *columns: Floats) -> tuple[Ints, Ints, list[Floats]]:
    """
    Return the means of columns over windows of SLOW_WINDOW that hold enough rows, and how many.

    t : (n,) s, from the first of which windows are counted.   columns : (n,) each.   Returns
    (k,) rows in a window, (k,) window numbers, and a list of (k,) means.
    """
    window = ((t - t[0]) / SLOW_WINDOW).astype(int)
    count = np.bincount(window)
    full = np.flatnonzero(count >= max(5, 0.5 * count.max()))
    return count[full], full, [np.bincount(window, x)[full] / count[full] for x in columns]


def slow_variance(t: Floats, along: Floats, way: Floats, variance: Floats,
                  drift: float) -> tuple[float, float]:
    """
    Return the variance of fix errors averaged over SLOW_WINDOW, m^2, and how long they last, s.

    Means of the residuals over windows hold it, where white errors have averaged down. A fifth of
    the variance being slow is not seen in a mark's own scatter, and yet rules its mean. Along the
    chord, since gyros bend a track across it; less a straight line over the path, which is what
    the errors of the two marks themselves make.

    t, along, way : (n,) times, s, corrected track less fixes along the chord, m, and how far along
    it, m.   variance : (n,) as stated, m^2.   drift : what the gyros may have done along it, m: no
    error of the fixes.
    """
    count, number, (means, places) = window_means(t, along, way)
    if len(count) < 5:      # with a mean and a slope taken out, a variance by five is good to 80 %
        return 0.0, np.inf
    means, places = means - means.mean(), places - places.mean()
    means = means - places * (places @ means) / max(places @ places, 1e-9)
    free = len(count) - 2
    jump = np.median(np.diff(along)**2) / 0.4549 / 2      # median of a squared normal deviate
    white = min(jump, np.median(variance)) / np.median(count)
    seen = (means**2).sum() / free - drift**2
    # within three sigmas of the mean square of so many windows, white errors alone may do it
    if seen <= white * (1 + 3 * np.sqrt(2 / free)):
        return 0.0, np.inf
    next_to = (means[1:] * means[:-1])[np.diff(number) == 1]
    alike = (next_to.mean() - drift**2) / (seen - white) if len(next_to) else 1.0
    return float(seen - white), _lasting(alike)


def _lasting(alike: float) -> float:
    """Return the time constant, s, that makes neighbouring means of SLOW_WINDOW so correlated."""
    times = np.geomspace(2.0, 2000.0, 100)      # s, that such a window can determine
    x = SLOW_WINDOW / times
    correlation = (1 - np.exp(-x))**2 / (2 * (x - 1 + np.exp(-x)))
    return float(np.interp(alike, correlation, times))


def slow_share(seconds: float, tau: float) -> float:
    """Return the variance of a mean of slow errors over a time, against that over SLOW_WINDOW."""
    share = [2 * (x - 1 + np.exp(-x)) / x**2 if x > 1e-4 else 1.0
             for x in (seconds / tau, SLOW_WINDOW / tau)]       # of a Gauss-Markov process
    return float(share[0] / share[1])


def no_better(mark: MarkFix, slow: float, tau: float, span: tuple[float, float] | None,
              stated: float, up_ratio: float) -> MarkFix:
    """
    Return a mark no better than the slow part of the fix errors allows.

    A mark that has seen slow errors itself knows them as well as the leg does: it is widened only
    where it took them for white, or where the leg clearly says more.

    mark : with the variance of its own fixes.   slow, tau : as slow_variance returns them.   span
    : (begin, end) or None the standstill at the mark, s; None in motion.   stated : variance of
    one fix, m^2.   up_ratio : variance up against that in the level.
    """
    begin, end = span or (mark.t, mark.t)
    floor = slow * slow_share(end - begin, tau)
    own = (mark.covariance_n[0, 0] + mark.covariance_n[1, 1]) / 2
    unclear = 2.0       # ratio of variances: nearer, neither of two estimates is the better
    took_for_white = own * mark.used < unclear * stated
    if took_for_white or floor > unclear * own:
        return mark.at_least(floor, up_ratio)
    return mark


def marks_no_better(marks: tuple[MarkFix, MarkFix], spans: Floats, t: Floats, way_n: Floats,
                    chord_n: Floats, residual: Floats, covariance_n: Floats,
                    drift_n: Floats) -> tuple[MarkFix, MarkFix]:
    """
    Return both marks of a leg no better than the slow part of its fix errors allows.

    marks : (MarkFix, MarkFix) with the variance of their own fixes.   spans : (k, 2) standstills,
    s.   t, way_n, residual, covariance_n : (n,), (n, 3), (n, 3), (n, 3, 3) times of the fixes, s,
    corrected track there, track less fix, m, and stated, m^2.   chord_n : (3,) from mark to mark,
    m.   drift_n : (3, k) what the gyros may have bent the track by, m.
    """
    along = chord_n[:2] / np.hypot(*chord_n[:2])
    stated = np.einsum('nij,i,j->n', covariance_n[:, :2, :2], along, along)
    slow, tau = slow_variance(t, residual[:, :2] @ along, way_n[:, :2] @ along, stated,
                              float(np.linalg.norm(along @ drift_n[:2])))
    up_ratio = np.median(covariance_n[:, 2, 2] / stated)
    start, end = (no_better(mark, slow, tau, standing_at(mark.t, spans), np.median(stated),
                            up_ratio) for mark in marks)
    return start, end
