# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Robust sigmas by medians, and gaps in the times of rows."""

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import by_step

# statistical: medians of |x|, x normal with sigma 1, and of the length of two such, sqrt(2 ln 2)
NORMAL_MEDIAN, RAYLEIGH_MEDIAN = 0.6745, 1.1774
MISSING_INTERVALS = 2.5  # judgement: median intervals, a message or more is missing
GAP_INTERVALS = 5.0      # judgement: median intervals, a longer step is a gap


def robust_sigma(residual: NDArray[np.float64]) -> float:
    """Return the standard deviation of residuals that are mostly normal about 0: (n,)."""
    sigma: float = np.median(np.abs(residual)) / NORMAL_MEDIAN
    return sigma


def gaps_longer(t: Floats, limit: float) -> Floats:
    """Return begin and end of the steps in times, (n,) s, longer than ``limit`` s: (k, 2)."""
    k = np.flatnonzero(by_step(lambda t: np.diff(t) > limit, t))
    return np.stack([t[k], t[k + 1]], -1)


def gaps_in_rhythm(t: Floats) -> Floats:
    """Return begin and end of the steps far longer than the median interval: (k, 2) s."""
    fewest_intervals = 10    # least number of rows for an interval
    if len(t) < fewest_intervals:
        return np.empty((0, 2))
    shortest_gap = 0.2    # s
    return gaps_longer(t, max(GAP_INTERVALS * float(np.median(np.diff(t))), shortest_gap))
