# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Linear regression in which outliers have no influence: Beaton and Tukey 1974, biweight."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.time_series import robust_sigma

# robust sigmas beyond which a row has no weight; statistical: 95 % efficient on normal errors
TUKEY = 4.685


class RobustFit(NamedTuple):
    """Solution of y = A x."""

    x: Floats             # (k,)
    covariance: Floats    # (k, k) of x
    sigma: float          # of an element of y, from the median of the residuals


def robust_fit(A: Floats, y: Floats, min_sigma: float,
               prior: Sequence[float] | Floats | None = None,
               start: Sequence[float] | Floats | None = None) -> RobustFit:
    """
    Return the solution of y = A x by least squares with Tukey's weights.

    A, y : (n, k), (n,) design and values.   min_sigma : least sigma of y.   prior : (k,) sigmas
    of the coefficients about zero, inf: no prior.   start : (k,) coefficients that fit many rows;
    default: least squares.
    """
    column_size = np.abs(A).max(axis=0)
    column_size[column_size == 0] = 1.0
    A = A / column_size      # a coefficient then has the unit of y
    information = np.zeros(A.shape[1]) if prior is None else (
        1 / (np.asarray(prior) * column_size)**2)
    weight, sigma = np.ones(len(y)), 0.0
    x = np.zeros(A.shape[1]) if start is None else np.asarray(start) * column_size
    tukey_passes = 20
    for k in range(tukey_passes):
        if k or start is not None:
            residual = y - A @ x
            sigma = max(robust_sigma(residual), min_sigma)
            u = residual / (TUKEY * sigma)
            # absolute values first (Huber): without a start Tukey's weights can converge anywhere
            huber = start is None and k < tukey_passes // 2
            weight = 1 / np.maximum(1.0, 3 * np.abs(u)) if huber else np.where(
                np.abs(u) < 1, (1 - u**2)**2, 0.0)
        H = (A * weight[:, None]).T @ A + np.diag(
            information * max(sigma, min_sigma)**2 + 1e-12 * len(y))
        x = np.linalg.solve(H, A.T @ (weight * y))
    covariance = np.linalg.inv(H) * sigma**2 / np.outer(column_size, column_size)
    return RobustFit(x / column_size, covariance, sigma)
