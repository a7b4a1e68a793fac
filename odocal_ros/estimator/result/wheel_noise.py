# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A line fitted to increments with a random walk and reading errors: (W5) to (W7).

The reading error at a node is in the increment that ends there and, with opposite sign, in the one
that begins there: the covariance of the increments is tridiagonal, and reading errors do not
accumulate.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS

# prior sigmas of the logarithm of a level: all walks together may differ by a factor of a thousand
# from their first value, each from their mean by three; reading errors are those of rounding.
# Judgement
WALK_SPREAD, APART_SPREAD, READING_SPREAD = 7.0, 1.0, 0.5
# judgement: iterations of the search for outliers, until variances change by less than a tenth;
# each removes nine tenths of their effect on a level
TAIL_ROUNDS, TAIL_SETTLED = 8, 0.1


@dataclass(frozen=True, eq=False)
class Increments:
    """The observations y = X x + errors, in m."""

    y: Floats       # (k,)
    X: Floats       # (k, p)
    prior: Floats   # (p,) sigmas of x about ``centre``, inf: none
    centre: Floats  # (p,)
    reading: float  # m^2, variance of the error at a node
    share: Floats   # (k,) variance of the walk in each increment at a level of 1
    kind: Ints      # (k,) index of its level
    walk: Floats    # m^2, first levels


@dataclass(frozen=True, eq=False)
class Line:
    """The line found."""

    x: Floats           # (p,)
    covariance: Floats  # (p, p)
    levels: Floats      # m^2, of the walk
    gain: Floats        # (p, k) derivatives of x by the increments


def fit_line(seen: Increments) -> Line:
    """Return the line at the maximum of the restricted likelihood, with down-weighted outliers."""
    from scipy.optimize import minimize
    spread = np.ones(len(seen.y))
    log_levels = np.zeros(len(seen.walk) + 1)
    for _ in range(TAIL_ROUNDS):
        simplex = log_levels + np.concatenate([np.zeros((1, len(log_levels))), -2 * np.eye(
            len(log_levels))])
        found = minimize(_minus_log_likelihood, log_levels, args=(seen, spread),
                         method='Nelder-Mead', options={
                             'xatol': 0.05, 'fatol': 0.02, 'initial_simplex': simplex})
        log_levels = found.x
        x, covariance, _, banded, root = _solved(log_levels, seen, spread)
        off = _left_out(banded, root, seen.y - seen.X @ x)
        before, spread = spread, np.maximum(spread * (off / TAIL_SIGMAS)**2, 1.0)
        if np.allclose(spread, before, rtol=TAIL_SETTLED):
            break
    gain = covariance @ cho_solve_banded((root, False), seen.X, check_finite=False).T
    return Line(x, covariance, seen.walk * np.exp(log_levels[:-1]), gain)


def _solved(log_levels: Floats, seen: Increments,
            spread: Floats) -> tuple[Floats, Floats, float, Floats, Floats]:
    """Return x, its covariance, -2 log likelihood, increments' covariance and root (banded)."""
    reading = seen.reading * np.exp(log_levels[-1])
    walk = (seen.walk * np.exp(log_levels[:-1]))[seen.kind] * seen.share * spread
    banded = np.empty((2, len(seen.y)))
    banded[0], banded[1] = -reading, walk + 2 * reading
    root = cholesky_banded(banded, check_finite=False)
    both = np.column_stack([seen.X, seen.y - seen.X @ seen.centre])
    inverse = both.T @ cho_solve_banded((root, False), both, check_finite=False)
    information = inverse[:-1, :-1] + np.diag(1 / seen.prior**2)
    covariance = np.linalg.inv(information)
    step = covariance @ inverse[:-1, -1]
    cost = (2 * np.log(root[1]).sum() + np.linalg.slogdet(information)[1] + inverse[-1, -1]
            - step @ information @ step)
    return seen.centre + step, covariance, float(cost), banded, root


def _minus_log_likelihood(log_levels: Floats, seen: Increments, spread: Floats) -> float:
    walk, reading = log_levels[:-1], log_levels[-1]
    held = (walk.mean()**2 / WALK_SPREAD**2 + ((walk - walk.mean())**2).sum() / APART_SPREAD**2
            + reading**2 / READING_SPREAD**2)
    return (_solved(log_levels, seen, spread)[2] + float(held)) / 2


def _left_out(banded: Floats, root: Floats, residual: Floats) -> Floats:
    """Return leave-one-out residuals of the increments, in sigmas: (k,)."""
    weighted = cho_solve_banded((root, False), residual, check_finite=False)
    before, after = banded[1].copy(), banded[1].copy()
    square, k = banded[0, -1]**2, len(residual)
    for i in range(1, k):
        before[i] -= square / before[i - 1]
        after[k - 1 - i] -= square / after[k - i]
    off: Floats = weighted * np.sqrt(before + after - banded[1])
    return off
