# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Reference positions at the marks: mean of the fixes over a standstill, or around a mark in motion.

The error of the mean depends on the correlation time of fix errors. The stated covariance is the
total error; the scatter shows the fast part, which changes from fix to fix and averages down. The
slow part does so only if the data show that it changes within the window too. Errors that are
constant during a mark are observable along the leg, but not at the mark.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.nav.time_series import NORMAL_MEDIAN, RAYLEIGH_MEDIAN
from odocal_ros.settings.levels import OUTLIER_SIGMAS

# path of an antenna, up to a constant: t (n,) s to (n, 3) m in n, or t () to (3,)
Path = Callable[[Floats], Floats]
# s, least half-window of fixes about a mark in motion. Judgement: over two seconds the error of
# dead reckoning is smaller than that of a fix
MARK_WINDOW = 1.0
# fewest fixes whose scatter is used for the correlation of their errors. Statistical: a variance
# by 20 has a sigma of 30 %
MIN_SCATTERED_FIXES = 20
# s, window in which white errors average down and slow ones do not. Physical: slow errors of
# receivers last a minute and more
SLOW_WINDOW = 20.0


@dataclass(frozen=True, eq=False)
class MarkFix:
    """Antenna position at a mark."""

    t: float                   # s, of the mark
    position_n: Floats         # (3,) m
    covariance_n: Floats       # (3, 3) m^2
    standing: bool             # True: averaged at rest
    fix_count: int             # number of fixes used
    height_known: bool = True  # False if any fix has no height
    surveyed: bool = False     # True: from settings


class MeanFix(NamedTuple):
    """Mean of the fixes of one place."""

    position_n: Floats      # (3,) m
    covariance_n: Floats    # (3, 3) m^2
    fix_count: int          # number of fixes used, without outliers


def mean_fix(t: Floats, position_n: Floats, covariance_n: Floats,
             correlation_time: float = np.nan) -> MeanFix:
    """
    Return the mean of the fixes of one place: docs/method.md (T6), (T7).

    t : (n,) times, s.   position_n : (n, 3) fixes, m, motion removed.   covariance_n : (n, 3, 3)
    stated, m^2.   correlation_time : of the errors, s; 0: white; NaN: estimated from the data.
    """
    keep = _inliers(position_n, covariance_n)
    t, position_n, covariance_n = t[keep], position_n[keep], covariance_n[keep]
    weight = 1 / np.trace(covariance_n[:, :2, :2], axis1=1, axis2=2)
    weight = weight / weight.sum()
    mean = weight @ position_n
    fix_covariance = np.einsum('n,nij->ij', weight, covariance_n)      # of a single fix
    share = _variance_share(t, position_n - mean, fix_covariance, weight, correlation_time)
    return MeanFix(mean, fix_covariance * share, int(keep.sum()))


def _inliers(position_n: Floats, covariance_n: Floats) -> Bools:
    """Return a mask of fixes, (n,), within five robust sigmas of the median, horizontal and up."""
    deviation = np.abs(position_n - np.median(position_n, axis=0))
    horizontal, up = np.hypot(deviation[:, 0], deviation[:, 1]), deviation[:, 2]
    stated = np.median(np.diagonal(covariance_n, axis1=1, axis2=2), axis=0)
    sigma = max(np.median(horizontal) / RAYLEIGH_MEDIAN,
                0.2 * np.sqrt((stated[0] + stated[1]) / 2))
    sigma_up = max(np.median(up) / NORMAL_MEDIAN, 0.2 * np.sqrt(stated[2]))
    return np.asarray((horizontal <= OUTLIER_SIGMAS * sigma) & (up <= OUTLIER_SIGMAS * sigma_up))


def _variance_share(t: Floats, residual: Floats, fix_covariance: Floats, weight: Floats,
                    correlation_time: float) -> float:
    """Return the variance of the mean over that of a single fix: docs/method.md (T7)."""
    # without a known correlation time, scatter and steps from fix to fix show whether errors are
    # white, or how large their fast and their slow part are
    n = len(t)
    white_share = float(weight @ weight)          # 1/n for equal weights
    if n == 1 or correlation_time == 0:
        return white_share
    if not np.isnan(correlation_time):
        return _mean_variance_share(t, weight, correlation_time)
    if n < MIN_SCATTERED_FIXES:
        return 1.0
    # variances of z, residuals over stated sigmas: for white errors, both are 1, within 3 sigma of
    # their own noise
    z = residual[:, :2] / np.sqrt(np.diag(fix_covariance))[:2]
    scatter = (z**2).sum() / (2 * (n - 1))
    half_square_step = (np.diff(z, axis=0)**2).mean() / 2
    tolerance = 3 * np.sqrt(1 / n)
    if scatter > 1 - tolerance and half_square_step > scatter * (1 - tolerance):
        return white_share * (scatter if scatter > 1 + tolerance else 1.0)
    fast_part = min(half_square_step, 1.0)
    slow_part = max(1.0, scatter) - fast_part
    tau = _correlation_time(t, z, fast_part, slow_part)
    return float(fast_part * white_share + slow_part * _mean_variance_share(t, weight, tau))


def _mean_variance_share(t: Floats, weight: Floats, tau: float) -> float:
    """Return the variance share of a mean of Gauss-Markov errors with correlation time tau, s."""
    if tau == np.inf:
        return 1.0
    max_rows = 400      # limits the size of the correlation matrix
    rows = np.unique(np.linspace(0, len(t) - 1, min(len(t), max_rows)).round().astype(int))
    w = weight[rows] / weight[rows].sum()
    correlation = np.exp(-np.abs(t[rows][:, None] - t[rows]) / tau)
    return float(max(w @ correlation @ w, weight @ weight))


def _correlation_time(t: Floats, z: Floats, fast_part: float, slow_part: float) -> float:
    """Return the correlation time of the slow part, s: structure function at a quarter window."""
    # z : (n, 2) residuals over stated sigmas.  fast_part, slow_part : their variances in z
    lag = max(1, len(t) // 4)
    growth = ((z[lag:] - z[:-lag])**2).mean() / 2 - fast_part    # slow_part (1 - correlation)
    one_minus_correlation = np.clip(growth / slow_part, 0.0, 0.95) if slow_part > 0 else 0.95
    if one_minus_correlation <= 0:
        return np.inf
    return float(np.median(t[lag:] - t[:-lag]) / -np.log1p(-one_minus_correlation))


def standing_at(t_mark: float, spans: Floats | Sequence[tuple[float, float]],
                ) -> tuple[float, float] | None:
    """Return the standstill (begin, end) at most half a second from a mark, or None."""
    return next(((float(begin), float(end)) for begin, end in spans
                 if begin - 0.5 <= t_mark <= end + 0.5), None)


def fix_at(t_mark: float, span: tuple[float, float] | None, fixes: tuple[Floats, Floats, Floats],
           displacement_n: Callable[[Floats], Floats], correlation_time: float,
           window: float) -> MarkFix | None:
    """
    Return the antenna position at a mark at t_mark, s.

    span : (begin, end) of the standstill at the mark, s; None in motion.   fixes : (t, position_n,
    covariance_n) of the leg.   displacement_n : function of (n,) times to the (n, 3) motion from
    the mark, m.   correlation_time : as in mean_fix.   window : s each side of a mark in motion.
    """
    t, position_n, covariance_n = fixes
    low, high = span if span else (t_mark - window, t_mark + window)
    rows = np.flatnonzero((t >= low) & (t <= high))
    if not len(rows):
        if not len(t) or span is None:
            return None
        nearest = np.argmin(np.abs(t - t_mark))
        if abs(t[nearest] - t_mark) > window:
            return None
        rows = np.array([nearest])
    at_mark = position_n[rows] - displacement_n(t[rows])
    height_known = bool(np.isfinite(at_mark[:, 2]).all())
    at_mark = np.where(np.isfinite(at_mark), at_mark, 0.0)
    mean = mean_fix(t[rows], at_mark, covariance_n[rows], correlation_time)
    return MarkFix(t_mark, mean.position_n, mean.covariance_n, span is not None, mean.fix_count,
                   height_known)


class WindowMeans(NamedTuple):
    """Means of columns over k windows of SLOW_WINDOW with enough rows."""

    rows: Ints              # (k,) their number in each window
    number: Ints            # (k,) number of the window, from 0: those with few rows are missing
    means: list[Floats]     # (k,) of each column


def window_means(t: Floats, *columns: Floats) -> WindowMeans:
    """Return means of columns, (n,) each, over windows that begin at the first of t, (n,) s."""
    window = ((t - t[0]) / SLOW_WINDOW).astype(int)
    count = np.bincount(window)
    full = np.flatnonzero(count >= max(5, 0.5 * count.max()))
    return WindowMeans(count[full], full,
                       [np.bincount(window, x)[full] / count[full] for x in columns])


def slow_variance(t: Floats, along: Floats, place: Floats, variance: Floats,
                  drift: float) -> tuple[float, float]:
    """
    Return the variance of slow fix errors over SLOW_WINDOW, m^2, and their correlation time, s.

    It is the variance of the mean residuals of windows, less that by white errors, which average
    down there. A slow part of a fifth of the variance is not observable in the scatter at a mark,
    but dominates its mean. A straight line over the path, the effect of the errors of the two
    marks, is removed.

    t, along, place : (n,) s, corrected track minus fixes along the chord, m, and position there,
    m.   variance : (n,) stated, m^2.   drift : possible track error by gyro drift along it, m.
    """
    windows = window_means(t, along, place)
    if len(windows.rows) < 5:      # after mean and slope, a variance by five has a sigma of 80 %
        return 0.0, np.inf
    means, places = (x - x.mean() for x in windows.means)
    means = means - places * (places @ means) / max(places @ places, 1e-9)
    freedom = len(means) - 2
    # median of a squared normal deviate: 0.4549
    fix_to_fix = np.median(np.diff(along)**2) / 0.4549 / 2
    white = min(fix_to_fix, np.median(variance)) / np.median(windows.rows)
    total = (means**2).sum() / freedom - drift**2
    # within three sigmas of the mean square by white errors alone
    if total <= white * (1 + 3 * np.sqrt(2 / freedom)):
        return 0.0, np.inf
    products = (means[1:] * means[:-1])[np.diff(windows.number) == 1]     # of adjacent windows
    correlation = (products.mean() - drift**2) / (total - white) if len(products) else 1.0
    return float(total - white), _time_constant(correlation)


def _time_constant(correlation: float) -> float:
    """Return the time constant, s, by the correlation of adjacent means of SLOW_WINDOW."""
    times = np.geomspace(2.0, 2000.0, 100)      # s, that such a window can determine
    x = SLOW_WINDOW / times
    return float(np.interp(correlation, (1 - np.exp(-x))**2 / (2 * (x - 1 + np.exp(-x))), times))


def slow_share(seconds: float, tau: float) -> float:
    """Return the variance of the mean of slow errors over a time, over that of SLOW_WINDOW."""
    share = [2 * (x - 1 + np.exp(-x)) / x**2 if x > 1e-4 else 1.0
             for x in (seconds / tau, SLOW_WINDOW / tau)]       # of a Gauss-Markov process
    return float(share[0] / share[1])


def with_slow_errors(mark: MarkFix, slow: float, tau: float, span: tuple[float, float] | None,
                     stated: float, up_ratio: float) -> MarkFix:
    """
    Return a mark with at least the variance of the slow fix errors.

    The variance from the fixes at a mark is as reliable as that from the leg, if it includes slow
    errors: it is increased only if it is that of white errors, or if the leg has clearly more.

    mark : with the variance from its fixes.   slow, tau : variance and correlation time from
    ``slow_variance``.   span : (begin, end) of the standstill at the mark, s; None in motion.
    stated : variance of one fix, m^2.   up_ratio : variance up over that of a horizontal axis.
    """
    begin, end = span or (mark.t, mark.t)
    leg_variance = slow * slow_share(end - begin, tau)
    mark_variance = (mark.covariance_n[0, 0] + mark.covariance_n[1, 1]) / 2
    unclear = 2.0       # ratio of variances: below, neither of two estimates is better
    is_white = mark_variance * mark.fix_count < unclear * stated
    if mark.surveyed or not (is_white or leg_variance > unclear * mark_variance):
        return mark
    increase = max(0.0, leg_variance - mark_variance) * np.diag([1.0, 1.0, up_ratio])
    return replace(mark, covariance_n=mark.covariance_n + increase)


def marks_with_slow_errors(marks: tuple[MarkFix, MarkFix], spans: Floats, t: Floats,
                           path_n: Floats, chord_n: Floats, residual: Floats, covariance_n: Floats,
                           drift_n: Floats) -> tuple[MarkFix, MarkFix]:
    """
    Return both marks of a leg with at least the variance of its slow fix errors.

    marks : with the variance from their fixes.   spans : (k, 2) standstills, s.   t, path_n,
    residual, covariance_n : (n,), (n, 3), (n, 3), (n, 3, 3) times of the fixes, s, corrected track
    there, m, track minus fix, m, and stated covariance, m^2.   chord_n : (3,) from mark to mark,
    m.   drift_n : (3, k) possible track error by gyro drift, m.
    """
    along = chord_n[:2] / np.hypot(*chord_n[:2])
    stated = np.einsum('nij,i,j->n', covariance_n[:, :2, :2], along, along)
    variance, tau = slow_variance(t, residual[:, :2] @ along, path_n[:, :2] @ along, stated,
                                  float(np.linalg.norm(along @ drift_n[:2])))
    up_ratio = np.median(covariance_n[:, 2, 2] / stated)
    start, end = (with_slow_errors(mark, variance, tau, standing_at(mark.t, spans),
                                   np.median(stated), up_ratio) for mark in marks)
    return start, end
