# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Values of a vehicle over its legs, and comparison of vehicles of the same vehicle model.

``history``: changes of a vehicle are steps in a value over its legs (tyres, pressure, a moved IMU)
and drift. The values are the sum of a constant, steps, a slope, outlier legs, and errors of known
covariance: independent errors of each leg, shared errors, and the random walk of a scale. Forward
selection adds the slope, step or outlier leg that explains most, while it is significant. Backward
elimination then drops terms that are no longer significant: no pair is kept if one alone explains
the values.

``population``: mean and spread of the vehicles of a vehicle model, with outliers.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.nav.time_series import NORMAL_MEDIAN

Floats = NDArray[np.float64]
# limit of a vehicle's deviation from the mean of its model. Statistical: by chance 1 in 16,000
MODEL_OUTLIER_SIGMAS = 4.0
MIN_VEHICLES = 3            # judgement: for a spread


class Change(NamedTuple):
    """A step of the value."""

    leg: int         # first leg with the changed value, from 0
    size: float
    sigma: float


class History(NamedTuple):
    """The history of a value; legs are counted from 0."""

    changes: tuple[Change, ...] = ()       # in order
    outliers: tuple[int, ...] = ()         # single outlier legs
    slope: float | None = None             # per unit of ``t``; None if not determined
    slope_sigma: float | None = None


def covariance(independent: Floats, shared: Sequence[Floats] = (), days: Floats | None = None,
               walk: float = 0.0) -> Floats:
    """
    Return the covariance of the values of n legs.

    independent : (n,) variance of independent errors.   shared : each (n, k), one-sigma effects of
    errors that legs share.   days : (n,) of a random walk.   walk : its sigma, per square root of
    a day.
    """
    smallest = 1e-18    # variance of a leg: the inverse exists
    V = np.diag(np.maximum(independent, smallest)) + sum((g @ g.T for g in shared), np.zeros(()))
    return V if days is None else V + walk**2 * np.minimum.outer(days, days)


def significance_limit(n: int) -> float:
    """Return the limit for significance of steps, outliers and slopes of n legs, in sigmas."""
    from scipy.special import ndtri
    false_alarms = 1e-3    # of vehicles without a change
    return float(-ndtri(false_alarms / (2 * max(1, 2 * n - 2))))


def history(y: Floats, V: Floats, t: Floats | None = None) -> History:
    """
    Return the changes of n values and their slope.

    y : (n,) values in the order of legs.   V : (n, n) their covariance.   t : (n,) for the slope.
    An outlier at the last leg is a change, since no later leg contradicts it.
    """
    n, step_count = len(y), len(y) - 1
    if n < 2:
        return History()
    has_slope = t is not None and np.ptp(t) > 0 and n > 2
    # whitened columns: y, the constant, and the candidates W: a step at each leg but the first;
    # each leg but the first and the last as an outlier; and the slope
    white = np.linalg.solve(np.linalg.cholesky(V), np.column_stack([
        y, np.tril(np.ones((n, n))), np.eye(n)[:, 1:n - 1],
        *([t - t[0]] if t is not None and has_slope else [])]))
    z, level, W = white[:, 0], white[:, 1], white[:, 2:]
    slope = W.shape[1] - 1 if has_slope else -1
    selected = sorted(_select(z, level[:, None], W, significance_limit(n)))
    size, sigma = _fit(z, np.column_stack([level, W[:, selected]]))
    # column of W -> its factor and sigma
    estimate = {k: (float(size[i]), float(sigma[i])) for i, k in enumerate(selected, 1)}
    if has_slope and slope not in estimate and n > len(selected) + 2:
        X = np.column_stack([level, W[:, selected], W[:, slope]])
        if np.linalg.matrix_rank(X) == X.shape[1]:
            size, sigma = _fit(z, X)
            estimate[slope] = float(size[-1]), float(sigma[-1])
    return History(tuple(Change(k + 1, *estimate[k]) for k in selected if k < step_count),
                   tuple(k - step_count + 1 for k in selected if step_count <= k != slope),
                   *estimate.get(slope, (None, None)))


def _select(z: Floats, level: Floats, W: Floats, limit: float) -> list[int]:
    """
    Return the columns of the candidates W that explain z with significance.

    z : (n,), level : (n, 1) constant, W : (n, c), whitened.   limit : sigmas.
    """
    selected: list[int] = []
    while len(selected) < (len(z) - 1) // 2 or not selected:
        # z and W minus their projections on level and selected changes
        Q, _ = np.linalg.qr(np.column_stack([level, W[:, selected]]))
        residual, W_residual = z - Q @ (Q.T @ z), W - Q @ (Q.T @ W)
        size = np.linalg.norm(W_residual, axis=0)
        sigmas = np.where(size > 1e-6 * np.linalg.norm(W, axis=0), W_residual.T @ residual
                          / np.maximum(size, 1e-300), 0.0)
        best = int(np.argmax(np.abs(sigmas)))
        if abs(sigmas[best]) <= limit:
            break
        selected.append(best)
    while selected:
        size, sigma = _fit(z, np.column_stack([level, W[:, selected]]))
        sigmas = np.abs(size[1:] / sigma[1:])
        if sigmas.min() > limit:
            break
        del selected[int(sigmas.argmin())]
    return selected


def _fit(z: Floats, X: Floats) -> tuple[Floats, Floats]:
    """Return the least-squares factors of the columns of X for z, of unit variance; sigmas."""
    C = np.linalg.inv(X.T @ X)
    return C @ (X.T @ z), np.sqrt(np.diag(C))


class Population(NamedTuple):
    """Values of the vehicles of a vehicle model."""

    mean: float           # robust
    sigma: float          # of the mean
    spread: float         # between vehicles, in addition to their sigmas, 1 sigma
    deviates: Floats      # (n,) deviations over spread and sigma; nan for too few vehicles


def population(values: Floats, sigmas: Floats) -> Population:
    """
    Return the population of vehicles, values (n,) with their sigmas.

    The spread makes the median deviation that of a normal distribution; the mean is Huber's. Both
    are robust to outliers.
    """
    values, sigmas = np.asarray(values, float), np.asarray(sigmas, float)
    mean, spread = float(np.median(values)), 0.0
    if len(values) < MIN_VEHICLES:
        return Population(mean, float(sigmas.max()), 0.0, np.full(len(values), np.nan))
    huber = 1.5    # sigmas from which a vehicle has less weight
    max_passes = 50
    for _ in range(max_passes):
        previous = mean
        deviation = np.abs(values - mean)
        spread = _spread(deviation, sigmas)
        total = np.hypot(sigmas, max(spread, 1e-300))
        weight = np.minimum(1.0, huber * total / np.maximum(deviation, 1e-300)) / total**2
        mean = float(weight @ values / weight.sum())
        if abs(mean - previous) <= 1e-12 * max(float(total.min()), 1e-300):
            break
    return Population(mean, float(weight.sum()**-0.5), spread, (values - mean) / total)


def _spread(deviation: Floats, sigmas: Floats) -> float:
    """Return the spread at which the median of deviations over sigma is that of a normal one."""
    if np.median(deviation / np.maximum(sigmas, 1e-300)) <= NORMAL_MEDIAN:
        return 0.0
    low, high = 0.0, float(deviation.max()) / NORMAL_MEDIAN
    for _ in range(60):      # bisection to the last digit
        middle = (low + high) / 2
        too_small = np.median(deviation / np.hypot(sigmas, middle)) > NORMAL_MEDIAN
        low, high = (middle, high) if too_small else (low, middle)
    return high
