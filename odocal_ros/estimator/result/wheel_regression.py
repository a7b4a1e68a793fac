# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Regression of the increments of a wheel, y = X x + errors: docs/method.md (W5) to (W7).

The errors are a random walk, and reading errors at the nodes between the increments. The reading
error of a node is in the increment before it and, with opposite sign, in the one after it: the
covariance of the increments is tridiagonal. Three levels of the walk and one of the reading errors
maximise the restricted likelihood. Outliers have a larger variance.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS

UNUSABLE_WALK_TIME = 1e10   # s, definition: ``Increments.walk_time`` without information
# judgement: prior sigmas of the logarithms of the levels: mean of the walks about the initial
# value, each walk about their mean, and reading errors about those of rounding
WALK_SPREAD, WALK_DIFFERENCE_SPREAD, READING_SPREAD = 7.0, 1.0, 0.5
# lower limit of these logarithms, definition: wheels of a forecast have no noise, and their levels
# would decrease until the equations are singular
MIN_LOG_LEVEL = -20.0
# judgement: iterations of the search for outliers, until variances change by less than a tenth;
# each removes nine tenths of their effect on a level
MAX_OUTLIER_PASSES, OUTLIER_TOLERANCE = 8, 0.1


@dataclass(frozen=True, eq=False)
class Increments:
    """The observations y = X x + errors of one wheel, with their noise, (W5)."""

    y: Floats          # (k,) m, increments of the reading of a wheel minus the mean
    X: Floats          # (k, p)
    prior: Floats      # (p,) prior sigmas of x, inf: none
    mean: Floats       # (p,) prior means of x
    reading: float     # m^2, initial variance of the reading error at a node
    walk_time: Floats  # (k,) s, variance of the walk in each increment over the level of its kind
    kind: Ints         # (k,) index in ``walk``: 0 constant speed, 1 acceleration, 2 turns
    walk: Floats       # (3,) m^2/s, initial levels


@dataclass(frozen=True, eq=False)
class Regression:
    """The estimate of x."""

    x: Floats           # (p,)
    covariance: Floats  # (p, p)
    levels: Floats      # (3,) m^2/s, of the walk
    gain: Floats        # (p, k) derivatives of x by y


class _Solution(NamedTuple):
    """The estimate of x at given levels."""

    x: Floats           # (p,)
    covariance: Floats  # (p, p)
    cost: float         # -2 ln likelihood, plus a constant
    banded: Floats      # (2, k) covariance of y: the diagonal above the main one, the main one
    root: Floats        # (2, k) its Cholesky factor


def fit_regression(data: Increments) -> Regression:
    """Return the estimate at the maximum of the restricted likelihood, (W6), without outliers."""
    from scipy.optimize import minimize
    factor = np.ones(len(data.y))      # on the variances of outliers, u of (W7)
    log_levels = np.zeros(len(data.walk) + 1)
    corners = -2 * np.eye(len(log_levels) + 1)[:, 1:]      # of the first simplex, less its origin
    for _ in range(MAX_OUTLIER_PASSES):
        minimum = minimize(
            _minus_log_likelihood, log_levels, args=(data, factor), method='Nelder-Mead',
            options={'xatol': 0.05, 'fatol': 0.02, 'initial_simplex': log_levels + corners})
        log_levels = np.maximum(minimum.x, MIN_LOG_LEVEL)
        fitted = _solve(log_levels, data, factor)
        z = _leave_one_out(fitted.banded, fitted.root, data.y - data.X @ fitted.x)
        before, factor = factor, np.maximum(factor * (z / TAIL_SIGMAS)**2, 1.0)
        if np.allclose(factor, before, rtol=OUTLIER_TOLERANCE):
            break
    gain = fitted.covariance @ cho_solve_banded(
        (fitted.root, False), data.X, check_finite=False).T
    return Regression(fitted.x, fitted.covariance, data.walk * np.exp(log_levels[:-1]), gain)


def _solve(log_levels: Floats, data: Increments, factor: Floats) -> _Solution:
    """Return the solution; factor : (k,) on the variances of outliers."""
    levels = np.exp(np.maximum(log_levels, MIN_LOG_LEVEL))
    reading = data.reading * levels[-1]
    walk = (data.walk * levels[:-1])[data.kind] * data.walk_time * factor
    banded = np.empty((2, len(data.y)))
    banded[0], banded[1] = -reading, walk + 2 * reading
    root = cholesky_banded(banded, check_finite=False)
    columns = np.column_stack([data.X, data.y - data.X @ data.mean])
    products = columns.T @ cho_solve_banded((root, False), columns, check_finite=False)
    information = products[:-1, :-1] + np.diag(1 / data.prior**2)
    covariance = np.linalg.inv(information)
    step = covariance @ products[:-1, -1]
    cost = (2 * np.log(root[1]).sum() + np.linalg.slogdet(information)[1] + products[-1, -1]
            - step @ information @ step)
    return _Solution(data.mean + step, covariance, float(cost), banded, root)


def _minus_log_likelihood(log_levels: Floats, data: Increments, factor: Floats) -> float:
    """Return minus (W6), with the priors of the levels."""
    walk, reading = log_levels[:-1], log_levels[-1]
    differences = walk - walk.mean()
    prior = (walk.mean()**2 / WALK_SPREAD**2 + (differences**2).sum() / WALK_DIFFERENCE_SPREAD**2
             + reading**2 / READING_SPREAD**2)
    return (_solve(log_levels, data, factor).cost + float(prior)) / 2


def _leave_one_out(banded: Floats, root: Floats, residual: Floats) -> Floats:
    """Return the leave-one-out residuals of the increments, in sigmas, z of (W7): (k,)."""
    weighted = cho_solve_banded((root, False), residual, check_finite=False)
    # pivots of the elimination from the first row on and from the last row back
    before, after = banded[1].copy(), banded[1].copy()
    square, k = banded[0, -1]**2, len(residual)
    for i in range(1, k):
        before[i] -= square / before[i - 1]
        after[k - 1 - i] -= square / after[k - i]
    z: Floats = weighted * np.sqrt(before + after - banded[1])
    return z
