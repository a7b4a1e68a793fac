# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Time series: integrals, gaps in the times of rows, sigmas and lines from medians.

Integrals of long columns are computed in pieces, bitwise equal to integrals at once.
"""

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import enclosing_slices, Floats, map_windows

# statistical: medians of |x|, x normal with sigma 1, and of the length of two such, sqrt(2 ln 2)
NORMAL_MEDIAN, RAYLEIGH_MEDIAN = 0.6745, 1.1774
MISSING_INTERVALS = 2.5  # judgement: median intervals, a message or more is missing
GAP_INTERVALS = 5.0      # judgement: median intervals, a longer step is a gap


def running_integral(t: Floats, x: Floats, start: float | Floats = 0.0) -> Floats:
    """Return ``start`` plus the integral of x, (n, ...), up to each row by the trapezoid rule."""
    out = np.empty_like(x)
    out[0] = start
    np.multiply((x[:-1] + x[1:]) / 2, np.diff(t).reshape(-1, *(1,) * (x.ndim - 1)), out=out[1:])
    return np.cumsum(out, axis=0, out=out)


def integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return the integral of x, (n, ...), from t[0] to rising times (m,): (m, ...)."""
    out, end = np.empty((len(times), *x.shape[1:])), 0.0
    for chunk, rows in enclosing_slices(times, t):
        integral = running_integral(t[rows], x[rows], end)
        end = integral[-1]
        out[chunk] = interpolated(times[chunk], t[rows], integral)
    return out


def double_integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return the integral of the integral of x, (n,), at rising times: (m,)."""
    out, end, double_end = np.empty(len(times)), 0.0, 0.0
    for chunk, rows in enclosing_slices(times, t):
        integral = running_integral(t[rows], x[rows], end)
        double = running_integral(t[rows], integral, double_end)
        end, double_end = integral[-1], double[-1]
        out[chunk] = interpolated(times[chunk], t[rows], double)
    return out


def interpolated(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return x, (n,) or (n, k), at times, linear between rows, constant outside."""
    if x.ndim == 1:
        return np.interp(times, t, x)
    return np.stack([np.interp(times, t, column) for column in x.T], -1)


def running_mean(x: Floats, side_rows: int) -> Floats:
    """Return the means of each row and ``side_rows`` rows to each side: (n,)."""
    padded, count = np.pad(x, side_rows, mode='edge'), 2 * side_rows + 1
    return np.convolve(padded, np.full(count, 1 / count), mode='valid')


def robust_sigma(residual: NDArray[np.float64]) -> float:
    """Return the standard deviation of residuals that are mostly normal about 0: (n,)."""
    sigma: float = np.median(np.abs(residual)) / NORMAL_MEDIAN
    return sigma


def gaps_longer(t: Floats, limit: float) -> Floats:
    """Return begin and end of the steps in times, (n,) s, longer than ``limit`` s: (k, 2)."""
    k = np.flatnonzero(map_windows(lambda t: np.diff(t) > limit, t))
    return np.stack([t[k], t[k + 1]], -1)


def gaps_in_rhythm(t: Floats) -> Floats:
    """Return begin and end of the steps far longer than the median interval: (k, 2) s."""
    min_intervals = 10    # least number of rows for an interval
    if len(t) < min_intervals:
        return np.empty((0, 2))
    shortest_gap = 0.2    # s
    return gaps_longer(t, max(GAP_INTERVALS * float(np.median(np.diff(t))), shortest_gap))


def fit_robust_line(t: Floats, y: Floats) -> tuple[float, float]:
    """Return value at the first time and slope of a line through points, (n,), from medians."""
    if len(t) < 3:
        return float(np.median(y)), 0.0
    # median slope of pairs of points that are far apart (Theil and Sen), of at most 400 points
    points = np.linspace(0, len(t) - 1, min(len(t), 400)).astype(int)
    i, j = points[np.stack(np.triu_indices(len(points), 1))]
    dt = t[j] - t[i]
    is_long = dt > (t[-1] - t[0]) / 4
    slope = float(np.median((y[j] - y[i])[is_long] / dt[is_long]))
    return float(np.median(y - slope * (t - t[0]))), slope
