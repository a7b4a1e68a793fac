# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale by section of the path, each with a sigma by the residuals of its fixes."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Complexes, Floats

# lags of the correlation of residuals, in blocks: judgement, the next block and one at which
# additional white noise does not hide it
BLOCK_LAGS = (1, 3)
# rotation and scale; residuals, m; sum of squared distances from the middle, m^2
Similarity = tuple[np.complexfloating, Complexes, float]
# judgement: grid of the correlation from block to block, finer where the sigma of a scale grows
MEMORIES = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98, 0.99])


@dataclass(frozen=True, eq=False)
class Sections:
    """
    Scale by section: length by the fixes over length dead reckoned as calibrated.

    begin, end : (k,) path length, m.   ratio, sigma : (k,), NaN: not determined by the fixes.
    """

    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    ratio: NDArray[np.float64]
    sigma: NDArray[np.float64]


def sections(path: Floats, reckoned_n: Floats, fix_n: Floats, sigma: Floats) -> Sections:
    """
    Return the scale of each tenth of the path, relative to the one used in dead reckoning.

    The dead-reckoned section is rotated, scaled and shifted onto its fixes by least squares; the
    scale is the ratio, so the heading has no effect. Its sigma is by the residuals: most of the
    stated error is common to both ends of a section. Fix errors are time-correlated: a first-order
    process is matched to power and correlation of the residuals, as means of a few fixes, of all
    sections together, including the effect of the fit on them.
    Errors that change more slowly than over a section are not included.

    path : (k,) path length at each fix, m, rising.   reckoned_n, fix_n : (k, 3) dead-reckoned and
    fixed positions, m.   sigma : (k,) stated for a fix, m per horizontal axis; a hundredth of its
    median is the lower limit of the error.
    """
    whole = path[-1] - path[0] if len(path) else 0.0
    fewest = 8      # fixes of a section, twice the parameters of its fit
    count = int(min(10, len(path) // fewest, whole // 10.0))      # tenths, of 10 m at least
    if count < 1:
        return Sections(*(np.empty(0) for _ in range(4)))
    edges = path[0] + whole * np.linspace(0.0, 1.0, count + 1)
    part = np.clip(np.searchsorted(edges, path, side='right') - 1, 0, count - 1)
    z, w = reckoned_n[:, 0] + 1j * reckoned_n[:, 1], fix_n[:, 0] + 1j * fix_n[:, 1]
    ratio, error = np.full(count, np.nan), np.full(count, np.nan)
    fits = {}
    for i in range(count):
        rows = np.flatnonzero(part == i)
        if len(rows) >= fewest and np.ptp(path[rows]) > 0:
            # means of fixes: 24 of them, with little noise from fix to fix
            blocks = np.array_split(rows, min(len(rows), 24))
            z_b, w_b = (np.array([x[b].mean() for b in blocks]) for x in (z, w))
            if (z_b != z_b[0]).any():      # else the path stays where it is
                fits[i] = _similarity(z_b, w_b)
    for i, found in zip(fits, _errors(list(fits.values()), float(np.median(sigma))),
                        strict=True):
        if found < 1.0:
            ratio[i], error[i] = abs(fits[i][0]), found
    return Sections(edges[:-1], edges[1:], ratio, error)


def _similarity(z: Complexes, w: Complexes) -> Similarity:
    """Return the similarity from z to w (complex, m) by least squares."""
    z, w = z - z.mean(), w - w.mean()
    spread = float(np.vdot(z, z).real)
    c = np.vdot(z, w) / spread
    return c, w - c * z, spread


def _errors(fits: list[Similarity], stated: float) -> list[float]:
    """Return the sigma of each scale."""
    if not fits:
        return []
    n = int(np.median([len(left) for _, left, _ in fits]))
    residual_power, widening, *correlations = _process(n)
    power = np.array([np.vdot(left, left).real / len(left) for _, left, _ in fits]) / 2
    whole = sum(np.vdot(left, left).real for _, left, _ in fits)
    at = np.arange(len(MEMORIES))
    # additional white noise hides the correlation at the next block, not at the longer lag: the
    # larger memory counts; the longer lag is used with enough blocks
    memory = max(np.interp(sum(np.vdot(left[:-lag], left[lag:]).real for _, left, _ in fits)
                           / whole if whole else 0.0, row, at)
                 for lag, row in zip(BLOCK_LAGS, correlations, strict=True) if lag == 1 or n >= 16)
    level = np.maximum(power, np.median(power)) / np.interp(memory, at, residual_power)
    level = np.maximum(level, (0.01 * stated)**2)    # lower limit from fix to fix
    return [float(np.sqrt(v * np.interp(memory, at, widening) / spread))
            for v, (_, _, spread) in zip(level, fits, strict=True)]


@lru_cache(maxsize=32)
def _process(n: int) -> Floats:
    """
    Return statistics of a line fitted to n rows of a first-order process, by its memory.

    Mean power of the residuals, the variance of the slope over that of white noise, and the
    correlation of the residuals at each lag, for a process of variance 1: each (len(MEMORIES),).
    Closed form: traces with the residual projector of a line.
    """
    x = np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], -1)
    x /= np.linalg.norm(x, axis=0)
    off = np.eye(n) - x @ x.T
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    table = []
    for memory in MEMORIES:
        R = memory**apart
        left = off @ R @ off
        table.append((np.trace(left) / n, x[:, 1] @ R @ x[:, 1],
                      *(np.trace(left, lag) / np.trace(left) for lag in BLOCK_LAGS)))
    return np.array(table).T
