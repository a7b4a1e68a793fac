# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Variance components of the wheels' equations: slow errors of fixes, wheel slip, rounding.

Restricted likelihood over a grid of sizes, with priors (what the receiver states is one): the
covariance used is the posterior mean, so that a sigma holds what is not known of the noise itself.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.marks import FEWEST_SCATTERED
from odocal_ros.calib.wheels.model import Bins
from odocal_ros.data.arrays import Floats

# judgement: grids of sizes, 0 for none: slow errors of the fixes, of their stated variance; slip
# of a wheel, m/sqrt(s)
SLOW_VARIANCES = np.append(0.0, np.geomspace(0.003, 300.0, 34))
SLIP_NOISES = np.append(0.0, np.geomspace(1e-5, 0.1, 41))
# prior probability of no slow error, and of no slip. Tuned: with 0.9 sigmas are smaller than
# errors where there is a little of either (docs/decisions/0007)
NOTHING_LASTS_PRIOR = 0.8
# priors of sizes, log-normal: median, and sigma of the logarithm. Judgement
SIZE_PRIORS = {
    'stated': (1.0, 0.5),       # variance of the fixes, of that stated
    'slow': (1.0, 2.0),         # of the part that lasts, where one does, of that stated
    'slip': (3e-3, 1.5),        # m/sqrt(s), where a wheel slips
    'rounding': (1.0, 0.7)}     # variance of rounding in motion, of independent draws; mean 1


@dataclass(frozen=True, eq=False)
class FixNoise:
    """
    What was judged of the fixes.

    white, slow : of the stated variance, from fix to fix, and lasting.   time : s, of the slow
    part, likeliest; NaN where none is.   covariance : (2N, 2N) m^2, of east and north bin means.
    """

    white: float
    slow: float
    time: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True)
class TurnNoise:
    """
    What was judged of the wheels' turn.

    slip : m^2/s, variance rate of each wheel.   counts : level of rounding in motion, as noise.py
    has it: variance of that of rows which round independently.
    """

    slip: float = 0.0
    counts: float = 1.0


def white_share(t_fix: Floats, residual: Floats, covariance_n: Floats, bins: Bins) -> float:
    """
    Return the variance of the fixes' errors from one to the next, of that stated.

    residual : (k, 2) fixes less track, m, of the fixes in the bins.
    """
    near = np.diff(t_fix[bins.fix]) < 3 * np.median(np.diff(t_fix[bins.fix]))
    stated = np.diagonal(covariance_n[bins.fix][:, :2, :2], axis1=1, axis2=2)
    step = np.diff(residual, axis=0)**2 / (stated[1:] + stated[:-1])
    if near.sum() < FEWEST_SCATTERED:
        return 1.0
    return max(float(step[near].mean()), 1e-4)      # of the stated variance: keeps it solvable


def judge_fixes(r: Floats, X: Floats, known: Floats, bins: Bins, t_fix: Floats,
                covariance_n: Floats, white: float, correlation_time: float) -> FixNoise:
    """
    Judge the slow part of the fixes' errors: docs/method.md (W9) to (W11).

    Parameters
    ----------
    r, X : (2N,), (2N, p) arrays
        Residuals east and north, and derivatives; rows of empty bins are ignored.
    known : (2N, 2N) array
        Covariance of all else.
    bins, t_fix, covariance_n
        Of the fixes: bins, times, s, and stated covariance, m^2.
    white : float
        As white_share returns it.
    correlation_time : float
        gnss.correlation_time: 0 white, NaN to be judged.

    """
    n = len(bins.edges) - 1
    stated = bins.mean(np.diagonal(covariance_n[bins.fix][:, :2, :2], axis1=1, axis2=2))
    cross = np.zeros((n, 2, 2))
    np.add.at(cross, bins.of_fix,
              covariance_n[bins.fix][:, :2, :2] * (bins.share**2)[:, None, None])
    W = np.zeros((2, n, 2, n))
    k = np.arange(n)
    W[:, k, :, k] = cross
    W = white * W.reshape(2 * n, 2 * n)
    if correlation_time == 0:
        return FixNoise(white, 0.0, np.nan, W)
    use = np.flatnonzero(np.tile(bins.filled, 2))
    root = np.sqrt(stated).T.ravel()
    times = np.array([correlation_time])
    if np.isnan(correlation_time):
        times = 5.0 * 2.0**np.arange(8)     # s, to 640
    begin, end = spread(bins, t_fix)
    shapes = [root[:, None] * np.kron(np.eye(2), slow_means(begin, end, time)) * root
              for time in times]
    log_prior = -0.5 * (np.log(white + SLOW_VARIANCES) / SIZE_PRIORS['stated'][1])**2
    log_prior += log_size_prior(SLOW_VARIANCES, *SIZE_PRIORS['slow'])
    cut = np.ix_(use, use)
    white_root = inverse_root((known + W)[cut])
    log = np.array([log_prior + evidence(r[use], X[use], white_root, S[cut], SLOW_VARIANCES)
                    for S in shapes])
    p = np.exp(log - log.max())
    p /= p.sum()
    best = np.unravel_index(np.argmax(p), p.shape)
    slow = sum((p[i] @ SLOW_VARIANCES) * S for i, S in enumerate(shapes))
    return FixNoise(white, float((p @ SLOW_VARIANCES).sum()),
                    float(times[best[0]]) if best[1] else np.nan, W + slow)


def judge_turns(r: Floats, X: Floats, known: Floats, counts: Floats, walk: Floats) -> TurnNoise:
    """
    Judge how far rounding to counts and slips make the wheels' turn err: (W10), (W11).

    Parameters
    ----------
    r, X : (N,), (N, p) arrays
        Residuals of the turn equation, and derivatives.
    known, counts, walk : (N, N) arrays
        Covariance of all else, of rounding in motion taken as independent draws, and of slips of
        1 m/sqrt(s).

    """
    levels = 2.0**(np.arange(-4, 8) / 1.5) if counts.any() else np.ones(1)
    spread = SIZE_PRIORS['rounding'][1]
    log_prior = -0.5 * ((np.log(levels) + spread**2 / 2) / spread)**2
    log_prior = log_prior[:, None] + log_size_prior(SLIP_NOISES, *SIZE_PRIORS['slip'])
    roots = [inverse_root(known + level * counts) for level in levels]
    log = log_prior + [evidence(r, X, root, walk, SLIP_NOISES**2) + np.log(np.diag(root)).sum()
                    for root in roots]
    p = np.exp(log - log.max())
    p /= p.sum()
    return TurnNoise(float((p @ SLIP_NOISES**2).sum()), float(levels @ p.sum(axis=1)))


def log_size_prior(sizes: Floats, usual: float, spread: float) -> Floats:
    """
    Return the log prior of sizes of a grid, the first of them 0, docs/method.md (W11): (n,).

    usual, spread : median of what there is, and sigma of its logarithm.
    """
    log = np.append(np.log(NOTHING_LASTS_PRIOR), -0.5 * (np.log(sizes[1:] / usual) / spread)**2)
    log[1:] += np.log(1 - NOTHING_LASTS_PRIOR) - np.log(np.exp(log[1:]).sum())
    return log


def inverse_root(covariance: Floats) -> Floats:
    """Return the inverse of the Cholesky root of a covariance, (n, n), kept solvable."""
    tiny = 1e-13 * np.diag(covariance).max()
    return np.linalg.inv(np.linalg.cholesky(covariance + tiny * np.eye(len(covariance))))


def evidence(r: Floats, X: Floats, root: Floats, shape: Floats, sizes: Floats) -> Floats:
    """
    Return the restricted log likelihood of r = X b + e, by size: docs/method.md (W10).

    cov e = known + size shape; but for ln det known. In the axes in which both are diagonal a
    size costs next to nothing.   root : inverse_root(known).
    """
    values, axes = np.linalg.eigh(root @ shape @ root.T)
    d = 1 + sizes[:, None] * np.maximum(values, 0.0)             # (sizes, n)
    e, half = axes.T @ (root @ r) / np.sqrt(d), (axes.T @ (root @ X)) / np.sqrt(d)[..., None]
    length = np.linalg.norm(half, axis=1)
    Q, R = np.linalg.qr(half / length[:, None])
    fitted = (e[:, None] @ Q)[:, 0]
    pivots = np.abs(np.diagonal(R, axis1=1, axis2=2)) * length
    out: Floats = -0.5 * (np.log(d).sum(axis=1) + 2 * np.log(pivots).sum(axis=1)
                          + (e**2).sum(axis=1) - (fitted**2).sum(axis=1))
    return out


def slow_means(begin: Floats, end: Floats, time: float) -> Floats:
    """
    Return the covariance of bin means of a unit Gauss-Markov process, (W9): (N, N).

    begin, end : (N,) s, of the fixes in each bin.   time : s, its time constant.
    """
    x = np.maximum((end - begin) / time, 1e-6)
    inside = np.where(x > 1e-3, 2 * (x - 1 + np.exp(-x)) / x**2, 1 - x / 3)
    mean = -np.expm1(-x) / x
    gap = np.maximum(begin[:, None] - end, begin - end[:, None])
    out = mean[:, None] * mean * np.exp(-np.maximum(gap, 0.0) / time)
    np.fill_diagonal(out, inside)
    return out


def spread(bins: Bins, t_fix: Floats) -> tuple[Floats, Floats]:
    """Return begin and end of the fixes of each bin, s; the middle of an empty one."""
    t, n = t_fix[bins.fix], len(bins.edges) - 1
    begin, end = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(begin, bins.of_fix, t)
    np.maximum.at(end, bins.of_fix, t)
    middle = (bins.edges[:-1] + bins.edges[1:]) / 2
    return np.where(begin > end, middle, begin), np.where(begin > end, middle, end)
