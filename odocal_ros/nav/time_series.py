# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Time series: integrals, gaps in the times of rows, sigmas and lines by medians.

Integrals of long columns are computed in pieces, bitwise equal to integrals at once.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import enclosing_slices, Floats, map_windows

# statistical: medians of |x|, x normal with sigma 1, and of the length of two such, sqrt(2 ln 2)
NORMAL_MEDIAN, RAYLEIGH_MEDIAN = 0.6745, 1.1774
MISSING_INTERVALS = 2.5  # judgement: median intervals, a message or more is missing
GAP_INTERVALS = 5.0      # judgement: median intervals, a longer step is a gap


class Integral:
    """The integral of (n, ...) by the trapezoid rule, over consecutive pieces."""

    def __init__(self) -> None:
        self.end = 0.0

    def over(self, t: Floats, x: Floats) -> Floats:
        """Return the integral at a piece's rows; its first row is the last of the one before."""
        out = np.empty_like(x)
        out[0] = self.end
        np.multiply((x[:-1] + x[1:]) / 2, np.diff(t).reshape(-1, *(1,) * (x.ndim - 1)),
                    out=out[1:])
        np.cumsum(out, axis=0, out=out)
        self.end = out[-1].copy()
        return out


def running_integral(t: Floats, x: Floats) -> Floats:
    """Return the integral of x, (n, ...), from t[0] to each row, linear between rows."""
    return Integral().over(t, x)


def integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return the integral of x, (n, ...), from t[0] to rising times (m,): (m, ...)."""
    return integrals_at([times], t, x)[0]


def integrals_at(times: Sequence[Floats], t: Floats, x: Floats) -> list[Floats]:
    """Return ``integral_at`` for each of several arrays of times."""
    return _at(times, t, x, Integral().over)


def twice_integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return the integral of the integral of x, (n,), at times, rising: (m,)."""
    return twice_integrals_at([times], t, x)[0]


def twice_integrals_at(times: Sequence[Floats], t: Floats, x: Floats) -> list[Floats]:
    """Return ``twice_integral_at`` for each of several arrays of times."""
    once, twice = Integral(), Integral()
    return _at(times, t, x, lambda t, x: twice.over(t, once.over(t, x)))


def _at(times: Sequence[Floats], t: Floats, x: Floats,
        over: Callable[[Floats, Floats], Floats]) -> list[Floats]:
    """Return an integral of x at times; over : integral at the rows of consecutive pieces."""
    integrals = [np.empty((len(each), *x.shape[1:])) for each in times]
    for parts in zip(*(enclosing_slices(each, t) for each in times), strict=True):
        rows = parts[0][1]
        integral = over(t[rows], x[rows])
        for each, (where, _), out in zip(times, parts, integrals, strict=True):
            interpolated(each[where], t[rows], integral, out[where])
    return integrals


def interpolated(times: Floats, t: Floats, x: Floats, out: Floats) -> None:
    """Write x, (n,) or (n, k), at times to out, linear between rows."""
    if x.ndim == 1:
        out[:] = np.interp(times, t, x)
        return
    for k in range(x.shape[1]):
        out[:, k] = np.interp(times, t, x[:, k])


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
    """Return value at the first time and slope of a line through points, (n,), by medians."""
    if len(t) < 3:
        return float(np.median(y)), 0.0
    i, j = np.triu_indices(min(len(t), 400), 1)
    pick = np.linspace(0, len(t) - 1, min(len(t), 400)).astype(int)
    dt = t[pick][j] - t[pick][i]
    is_long = dt > (t[-1] - t[0]) / 4
    slope = float(np.median((y[pick][j] - y[pick][i])[is_long] / dt[is_long]))
    return float(np.median(y - slope * (t - t[0]))), slope
