# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Reference positions at the marks: mean of the fixes over a standstill, or around a mark in motion.

The error of the mean depends on the correlation time of fix errors. The stated covariance is the
total error; the scatter shows the part that changes from fix to fix. Only this part averages
down, unless the data show that the slow part changes within the window too. Errors that are
constant during a mark are observable along the leg, but not at the mark.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav.time_series import NORMAL_MEDIAN, RAYLEIGH_MEDIAN
from odocal_ros.settings.levels import OUTLIER_SIGMAS

Path = Callable[[Floats], Floats]     # t (n,) s to an antenna's path, (n, 3) m, or t () to (3,)
# s, least half-window of fixes about a mark in motion. Judgement: over two seconds the error of
# dead reckoning is smaller than that of a fix
MARK_WINDOW = 1.0
# fewest fixes whose scatter is used for the correlation of their errors. Statistical: a variance
# by 20 has a sigma of 30 %
FEWEST_SCATTERED = 20
# s, window in which white errors average down and slow ones do not. Physical: slow errors of
# receivers last a minute and more
SLOW_WINDOW = 20.0


@dataclass(frozen=True, eq=False)
class MarkFix:
    """Antenna position at a mark."""

    t: float                   # s, of the mark
    position_n: Floats         # (3,) m
    covariance_n: Floats       # (3, 3) m^2
    standing: bool             # averaged at rest
    used: int                  # fixes
    height_known: bool = True  # False if any fix has no height
    surveyed: bool = False     # from settings


def mean_fix(t: Floats, position_n: Floats, covariance_n: Floats,
             correlation_time: float = np.nan) -> tuple[Floats, Floats, int]:
    """
    Return mean, (3,) m, covariance, (3, 3) m^2, and used fixes of one place: (T6), (T7).

    t : (n,) times, s.   position_n : (n, 3) fixes, m, motion removed.   covariance_n : (n, 3, 3)
    stated, m^2.   correlation_time : of the errors, s; 0: white; NaN: estimated from the data.
    """
    keep = _inliers(position_n, covariance_n)
    t, position_n, covariance_n = t[keep], position_n[keep], covariance_n[keep]
    weight = 1 / np.trace(covariance_n[:, :2, :2], axis1=1, axis2=2)
    weight = weight / weight.sum()
    mean = weight @ position_n
    whole = np.einsum('n,nij->ij', weight, covariance_n)
    share = _variance_share(t, position_n - mean, whole, weight, correlation_time)
    return mean, whole * share, int(keep.sum())


def _inliers(position_n: Floats, covariance_n: Floats) -> Bools:
    """Return the fixes within five robust sigmas of the median, horizontally and in height."""
    off = np.abs(position_n - np.median(position_n, axis=0))
    level, up = np.hypot(off[:, 0], off[:, 1]), off[:, 2]
    stated = np.median(np.diagonal(covariance_n, axis1=1, axis2=2), axis=0)
    spread = max(np.median(level) / RAYLEIGH_MEDIAN, 0.2 * np.sqrt((stated[0] + stated[1]) / 2))
    spread_up = max(np.median(up) / NORMAL_MEDIAN, 0.2 * np.sqrt(stated[2]))
    out: Bools = (level <= OUTLIER_SIGMAS * spread) & (up <= OUTLIER_SIGMAS * spread_up)
    return out


def _variance_share(t: Floats, residual: Floats, whole: Floats, weight: Floats,
                    correlation_time: float) -> float:
    """Return the variance of the mean over that of a single fix: docs/method.md (T7)."""
    n = len(t)
    white = float(weight @ weight)          # 1/n for equal weights
    if n == 1 or correlation_time == 0:
        return white
    if not np.isnan(correlation_time):
        return _mean_variance_share(t, weight, correlation_time)
    if n < FEWEST_SCATTERED:
        return 1.0
    sigma = np.sqrt(np.diag(whole))
    z = residual[:, :2] / sigma[:2]
    scatter = (z**2).sum() / (2 * (n - 1))
    step = (np.diff(z, axis=0)**2).mean() / 2
    # white fixes: scatter and half the squared steps are both 1, within 3 sigma of their own noise
    slack = 3 * np.sqrt(1 / n)
    if scatter > 1 - slack and step > scatter * (1 - slack):
        return white * (scatter if scatter > 1 + slack else 1.0)
    fast = min(step, 1.0)
    slow = max(1.0, scatter) - fast
    out: float = fast * white + slow * _mean_variance_share(t, weight,
                                                            _correlation_time(t, z, fast, slow))
    return out


def _mean_variance_share(t: Floats, weight: Floats, tau: float) -> float:
    """Return the variance share of a mean of Gauss-Markov errors with correlation time tau, s."""
    if tau == np.inf:
        return 1.0
    pick = np.unique(np.linspace(0, len(t) - 1, min(len(t), 400)).round().astype(int))
    w = weight[pick] / weight[pick].sum()
    correlation = np.exp(-np.abs(t[pick][:, None] - t[pick]) / tau)
    return float(max(w @ correlation @ w, weight @ weight))


def _correlation_time(t: Floats, z: Floats, fast: float, slow: float) -> float:
    """Return the correlation time of the slow part: structure function at a quarter window."""
    lag = max(1, len(t) // 4)
    grown = ((z[lag:] - z[:-lag])**2).mean() / 2 - fast
    moved = np.clip(grown / slow, 0.0, 0.95) if slow > 0 else 0.95
    if moved <= 0:
        return np.inf
    return float(np.median(t[lag:] - t[:-lag]) / -np.log1p(-moved))


def standing_at(t_mark: float, spans: Floats | Sequence[tuple[float, float]],
                ) -> tuple[float, float] | None:
    """Return the standstill (begin, end) at most half a second from a mark, or None."""
    return next(((float(begin), float(end)) for begin, end in spans
                 if begin - 0.5 <= t_mark <= end + 0.5), None)


def fix_at(t_mark: float, span: tuple[float, float] | None, fixes: tuple[Floats, Floats, Floats],
           displacement_n: Callable[[Floats], Floats], correlation_time: float,
           window: float) -> MarkFix | None:
    """
    Return the antenna position at a mark.

    t_mark : s.   span : (begin, end) or None the standstill at the mark, s; None in motion.
    fixes : (t, position_n, covariance_n) fixes of the leg.   displacement_n : (n,) times to the
    (n, 3) motion of the antenna from the mark, m, dead reckoned.   correlation_time : as in
    mean_fix.   window : seconds each side of a mark in motion.
    """
    t, position_n, covariance_n = fixes
    low, high = span if span else (t_mark - window, t_mark + window)
    pick = np.flatnonzero((t >= low) & (t <= high))
    if not len(pick):
        if not len(t) or span is None:
            return None
        nearest = np.argmin(np.abs(t - t_mark))
        if abs(t[nearest] - t_mark) > window:
            return None
        pick = np.array([nearest])
    p = position_n[pick] - displacement_n(t[pick])
    height_known = bool(np.isfinite(p[:, 2]).all())
    p = np.where(np.isfinite(p), p, 0.0)
    mean, covariance, used = mean_fix(t[pick], p, covariance_n[pick], correlation_time)
    return MarkFix(t_mark, mean, covariance, span is not None, used, height_known)


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
    if mark.surveyed or not (took_for_white or floor > unclear * own):
        return mark
    more = max(0.0, floor - own) * np.diag([1.0, 1.0, up_ratio])
    return replace(mark, covariance_n=mark.covariance_n + more)


def marks_with_slow_errors(marks: tuple[MarkFix, MarkFix], spans: Floats, t: Floats,
                           path_n: Floats, chord_n: Floats, residual: Floats, covariance_n: Floats,
                           drift_n: Floats) -> tuple[MarkFix, MarkFix]:
    """
    Return both marks of a leg with at least the variance of its slow fix errors.

    marks : (MarkFix, MarkFix) with the variance of their own fixes.   spans : (k, 2) standstills,
    s.   t, path_n, residual, covariance_n : (n,), (n, 3), (n, 3), (n, 3, 3) times of the fixes, s,
    corrected track there, m, track minus fix, m, and stated covariance, m^2.   chord_n : (3,) from
    mark to mark, m.   drift_n : (3, k) possible track error by gyro drift, m.
    """
    along = chord_n[:2] / np.hypot(*chord_n[:2])
    stated = np.einsum('nij,i,j->n', covariance_n[:, :2, :2], along, along)
    slow, tau = slow_variance(t, residual[:, :2] @ along, path_n[:, :2] @ along, stated,
                              float(np.linalg.norm(along @ drift_n[:2])))
    up_ratio = np.median(covariance_n[:, 2, 2] / stated)
    start, end = (with_slow_errors(mark, slow, tau, standing_at(mark.t, spans), np.median(stated),
                                   up_ratio) for mark in marks)
    return start, end
