# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Reference positions at the marks: mean of the fixes over a standstill, or around a mark in motion.

The error of the mean depends on the correlation time of fix errors. The stated covariance is the
total error; the scatter shows the part that changes from fix to fix. Only this part averages
down, unless the data show that the slow part changes within the window too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.statistics import NORMAL_MEDIAN, RAYLEIGH_MEDIAN
from odocal_ros.settings.levels import OUTLIER_SIGMAS

Path = Callable[[Floats], Floats]     # t (n,) s to an antenna's path, (n, 3) m, or t () to (3,)
# s, least half-window of fixes about a mark in motion. Judgement: over two seconds the error of
# dead reckoning is smaller than that of a fix
MARK_WINDOW = 1.0
# fewest fixes whose scatter is used for the correlation of their errors. Statistical: a variance
# by 20 has a sigma of 30 %
FEWEST_SCATTERED = 20


@dataclass(frozen=True, eq=False)
class MarkFix:
    """
    Antenna position at a mark.

    t : s, time of the mark.       position_n : (3,) m.       covariance_n : (3, 3) m^2.
    standing : averaged at rest.   used, dropped : fixes.     surveyed : from settings.
    height_known : False if any fix has no height.
    """

    t: float
    position_n: NDArray[np.float64]
    covariance_n: NDArray[np.float64]
    standing: bool
    used: int
    dropped: int
    height_known: bool = True
    surveyed: bool = False

    def at_least(self, variance: float, up_ratio: float) -> 'MarkFix':
        """Return the mark with at least a horizontal variance, m^2; the increase up is scaled."""
        if self.surveyed:
            return self
        level = (self.covariance_n[0, 0] + self.covariance_n[1, 1]) / 2
        more = max(0.0, variance - level) * np.diag([1.0, 1.0, up_ratio])
        return replace(self, covariance_n=self.covariance_n + more)


def mean_fix(t: Floats, position_n: Floats, covariance_n: Floats,
             correlation_time: float = np.nan) -> tuple[Floats, Floats, int, int]:
    """
    Average fixes of one place: docs/method.md (T6), (T7).

    t : (n,) times, s.   position_n : (n, 3) fixes, m, motion removed.   covariance_n : (n, 3, 3)
    stated, m^2.   correlation_time : of the errors, s; 0: white; NaN: estimated from the data.

    Returns
    -------
    mean : (3,) m.   covariance : (3, 3) of the mean, m^2.   used, dropped : int.

    """
    keep = _near_middle(position_n, covariance_n)
    t, position_n, covariance_n = t[keep], position_n[keep], covariance_n[keep]
    weight = 1 / np.trace(covariance_n[:, :2, :2], axis1=1, axis2=2)
    weight = weight / weight.sum()
    mean = weight @ position_n
    whole = np.einsum('n,nij->ij', weight, covariance_n)
    share = _share(t, position_n - mean, whole, weight, correlation_time)
    return mean, whole * share, int(keep.sum()), int((~keep).sum())


def _near_middle(position_n: Floats, covariance_n: Floats) -> Bools:
    """Return the fixes within five robust sigmas of the median, horizontally and in height."""
    off = np.abs(position_n - np.median(position_n, axis=0))
    level, up = np.hypot(off[:, 0], off[:, 1]), off[:, 2]
    stated = np.median(np.diagonal(covariance_n, axis1=1, axis2=2), axis=0)
    spread = max(np.median(level) / RAYLEIGH_MEDIAN, 0.2 * np.sqrt((stated[0] + stated[1]) / 2))
    spread_up = max(np.median(up) / NORMAL_MEDIAN, 0.2 * np.sqrt(stated[2]))
    out: Bools = (level <= OUTLIER_SIGMAS * spread) & (up <= OUTLIER_SIGMAS * spread_up)
    return out


def _share(t: Floats, residual: Floats, whole: Floats, weight: Floats,
           correlation_time: float) -> float:
    """Return the variance of the mean over that of a single fix: docs/method.md (T7)."""
    n = len(t)
    white = float(weight @ weight)          # 1/n for equal weights
    if n == 1 or correlation_time == 0:
        return white
    if not np.isnan(correlation_time):
        return _left(t, weight, correlation_time)
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
    out: float = fast * white + slow * _left(t, weight, _correlation_time(t, z, fast, slow))
    return out


def _left(t: Floats, weight: Floats, tau: float) -> float:
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
                slack: float = 0.5) -> tuple[float, float] | None:
    """Return the standstill (begin, end) at most ``slack`` s from a mark, or None."""
    for begin, end in spans:
        if begin - slack <= t_mark <= end + slack:
            return float(begin), float(end)
    return None


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
    mean, covariance, used, dropped = mean_fix(t[pick], p, covariance_n[pick], correlation_time)
    return MarkFix(t_mark, mean, covariance, span is not None, used, dropped, height_known)
