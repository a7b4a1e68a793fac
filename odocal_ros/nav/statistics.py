# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sigmas by a median, which half of the values may spoil."""

import numpy as np
from numpy.typing import NDArray

# statistical: medians of |x|, x normal with sigma 1, and of the length of two such, sqrt(2 ln 2)
NORMAL_MEDIAN, RAYLEIGH_MEDIAN = 0.6745, 1.1774


def robust_sigma(residual: NDArray[np.float64]) -> float:
    """Return the standard deviation of residuals that are mostly normal about 0: (n,)."""
    sigma: float = np.median(np.abs(residual)) / NORMAL_MEDIAN
    return sigma
