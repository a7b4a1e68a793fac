"""Scale by section of the way, each with the sigma that its own fixes leave."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SECTIONS = 10        # equal parts of the way
FEWEST = 8           # fixes of a section
MOST = 100           # fixes of a section that are used, evenly spread
SHORTEST = 10.0      # m, of a section
LEAST = 0.01         # of a stated sigma: fixes are not better than that, one to the next
MEMORIES = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98, 0.99])  # one fix to the next


@dataclass(frozen=True, eq=False)
class Sections:
    """
    Scale by section: length by the fixes over length dead reckoned as calibrated.

    begin, end : (k,) m driven.   ratio, sigma : (k,), NaN where the fixes do not tell.
    """

    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    ratio: NDArray[np.float64]
    sigma: NDArray[np.float64]


def sections(way, reckoned_n, fix_n, sigma) -> Sections:
    """
    Return the scale of each tenth of the way, relative to the one used in dead reckoning.

    The dead-reckoned piece is turned, stretched and shifted onto its fixes by least squares; the
    stretch is the ratio, so no heading enters. Its sigma is by what the fixes leave after that,
    not by what the receiver states, most of which is the same at both ends of a section. One fix
    errs like the next: a first-order process is matched to the residuals of all sections
    together, their power and lag-one correlation as they are after such a fit. Errors that
    change more slowly than over a section are not in it.

    Parameters
    ----------
    way : (k,) array
        m driven at each fix, rising.
    reckoned_n, fix_n : (k, 3) arrays
        Dead-reckoned and fixed positions, m.
    sigma : (k,) array
        Of a fix as stated, m per horizontal axis; a hundredth of it is the least believed.

    """
    whole = way[-1] - way[0] if len(way) else 0.0
    count = int(min(SECTIONS, len(way) // FEWEST, whole // SHORTEST))
    if count < 1:
        return Sections(*(np.empty(0) for _ in range(4)))
    edges = way[0] + whole * np.linspace(0.0, 1.0, count + 1)
    part = np.clip(np.searchsorted(edges, way, side='right') - 1, 0, count - 1)
    z, w = reckoned_n[:, 0] + 1j * reckoned_n[:, 1], fix_n[:, 0] + 1j * fix_n[:, 1]
    ratio, error = np.full(count, np.nan), np.full(count, np.nan)
    fits = {}
    for i in range(count):
        rows = np.flatnonzero(part == i)
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST)).astype(int))]
        if len(rows) >= FEWEST and np.ptp(way[rows]) > 0:
            fits[i] = _stretched(z[rows], w[rows])
    for i, found in zip(fits, _errors(list(fits.values()), float(np.median(sigma))),
                        strict=True):
        if found < 1.0:
            ratio[i], error[i] = abs(fits[i][0]), found
    return Sections(edges[:-1], edges[1:], ratio, error)


def _stretched(z, w):
    """Return the turn and stretch that takes z onto w (complex, m), what is left, and spread."""
    z, w = z - z.mean(), w - w.mean()
    spread = float(np.vdot(z, z).real)
    c = np.vdot(z, w) / spread
    return c, w - c * z, spread


def _errors(fits, stated):
    """Return the sigma of each stretch."""
    if not fits:
        return []
    n = int(np.median([len(left) for _, left, _ in fits]))
    left_over, alike, widening = _process(n)
    power = np.array([np.vdot(left, left).real / len(left) for _, left, _ in fits]) / 2
    lag = sum(np.vdot(left[:-1], left[1:]).real for _, left, _ in fits)
    whole = sum(np.vdot(left, left).real for _, left, _ in fits)
    memory = np.interp(lag / whole if whole else 0.0, alike, np.arange(len(MEMORIES)))
    at = np.arange(len(MEMORIES))
    level = np.maximum(power, np.median(power)) / np.interp(memory, at, left_over)
    level = np.maximum(level, (LEAST * stated)**2)
    return [float(np.sqrt(v * np.interp(memory, at, widening) / spread))
            for v, (_, _, spread) in zip(level, fits, strict=True)]


def _process(n):
    """
    Return what a line fitted to n rows of a first-order process leaves, by its memory.

    Mean power left and its lag-one correlation, and the variance of the slope over that of white
    noise, of a process of variance 1: each (len(MEMORIES),). Closed form: traces with the
    projector off a line.
    """
    x = np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], -1)
    x /= np.linalg.norm(x, axis=0)
    off = np.eye(n) - x @ x.T
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    table = []
    for memory in MEMORIES:
        R = memory**apart
        left = off @ R @ off
        table.append((np.trace(left) / n, np.trace(left, 1) / np.trace(left),
                      x[:, 1] @ R @ x[:, 1]))
    return np.array(table).T
