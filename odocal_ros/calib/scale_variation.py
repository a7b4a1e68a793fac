# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Scale of the fixes relative to dead reckoning, in sections of the path and in windows of time.

The scale in sections shows a change of the odometer scale during the drive. The scale in windows
of all lengths is the same, unless fix errors depend on the motion over seconds: with a receiver
that filters, dead-reckons or uses an odometer, and with late stamps.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Complexes, Floats
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS, TYRE_SPREAD

# lags of the correlation of residuals, in blocks. Judgement: the next block, and a lag at which
# white noise does not hide the correlation
BLOCK_LAGS = (1, 3)
# judgement: grid of the correlation from block to block, finer where the sigma of a scale grows
CORRELATIONS = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98, 0.99])
SIDE_SCATTER = 0.25    # judgement: share of the change by which sections on one side may differ
MAX_DECODING = 20.0    # judgement: largest factor between units, gears or decodings of a counter
WINDOWS = 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0     # s, definition
# judgement: parts of the leg for a sigma, lower limit of the number of windows
LEG_PARTS, MIN_WINDOWS = 8, 12
NO_WINDOWS = np.empty((0, 4))    # definition: empty result of ``window_scale``


class Similarity(NamedTuple):
    """Fit of one path onto another, in complex numbers x + y i: rotation, scale and shift."""

    factor: np.complexfloating    # rotation and scale
    residual: Complexes           # (n,) m
    spread: float                 # sum of squared distances of the path from its mean, m^2


@dataclass(frozen=True, eq=False)
class Sections:
    """Scale of k sections, (k,): length by the fixes over calibrated dead-reckoned length."""

    begin: Floats  # m, path length
    end: Floats    # m
    ratio: Floats  # NaN: not determined by the fixes
    sigma: Floats  # of the ratio


def sections(path: Floats, reckoned_n: Floats, fix_n: Floats, sigma: Floats) -> Sections:
    """
    Return the scale of each tenth of the path, relative to the one used in dead reckoning.

    The dead-reckoned section is rotated, scaled and shifted onto its fixes by least squares. The
    sigma is that of a first-order process whose residuals match those of all sections, averaged
    over a few fixes, in mean square and correlation. Errors constant in a section are excluded.

    path : (k,) path length at each fix, m, rising.   reckoned_n, fix_n : (k, 3) dead-reckoned and
    fixed positions, m.   sigma : (k,) stated for a fix, m per horizontal axis; a hundredth of its
    median is the lower limit of the error.
    """
    total = path[-1] - path[0] if len(path) else 0.0
    min_fixes = 8      # of a section, twice the parameters of its fit
    # of sections: ten, each with min_fixes and 10 m at least
    count = int(min(10, len(path) // min_fixes, total // 10.0))
    if count < 1:
        return Sections(*(np.empty(0) for _ in range(4)))
    edges = path[0] + total * np.linspace(0.0, 1.0, count + 1)
    section = np.clip(np.searchsorted(edges, path, side='right') - 1, 0, count - 1)
    reckoned, fixed = (p[:, 0] + 1j * p[:, 1] for p in (reckoned_n, fix_n))
    ratio, ratio_sigma = np.full(count, np.nan), np.full(count, np.nan)
    fits = {}
    for i in range(count):
        rows = np.flatnonzero(section == i)
        if len(rows) >= min_fixes and np.ptp(path[rows]) > 0:
            # means of fixes: 24 of them, with little noise from fix to fix
            blocks = np.array_split(rows, min(len(rows), 24))
            source, target = (np.array([positions[block].mean() for block in blocks])
                              for positions in (reckoned, fixed))
            if (source != source[0]).any():      # else the path stays where it is
                fits[i] = _similarity(source, target)
    scale_sigmas = _scale_sigmas(list(fits.values()), float(np.median(sigma)))
    for i, scale_sigma in zip(fits, scale_sigmas, strict=True):
        if scale_sigma < 1.0:
            ratio[i], ratio_sigma[i] = abs(fits[i].factor), scale_sigma
    return Sections(edges[:-1], edges[1:], ratio, ratio_sigma)


def _similarity(source: Complexes, target: Complexes) -> Similarity:
    """Return the similarity from source to target, (n,) m, by least squares."""
    source, target = source - source.mean(), target - target.mean()
    spread = float(np.vdot(source, source).real)
    factor = np.vdot(source, target) / spread
    return Similarity(factor, target - factor * source, spread)


def _scale_sigmas(fits: list[Similarity], stated: float) -> list[float]:
    """Return the sigma of the scale of each fit; stated : sigma of a fix, m."""
    # errors: the first-order process with the observed mean square and correlation of residuals
    if not fits:
        return []
    residuals = [fit.residual for fit in fits]
    n = int(np.median([len(r) for r in residuals]))
    residual_power, slope_variance, *correlations = _residual_properties(n)
    power = np.array([np.vdot(r, r).real / len(r) for r in residuals]) / 2
    square = sum(np.vdot(r, r).real for r in residuals)
    # index in CORRELATIONS, with a fraction: the larger one, since white noise hides the
    # correlation at the next block. The longer lag needs enough blocks
    grid = np.arange(len(CORRELATIONS))
    index = max(np.interp(sum(np.vdot(r[:-lag], r[lag:]).real for r in residuals)
                          / square if square else 0.0, row, grid)
                for lag, row in zip(BLOCK_LAGS, correlations, strict=True) if lag == 1 or n >= 16)
    variance = np.maximum(power, np.median(power)) / np.interp(index, grid, residual_power)
    variance = np.maximum(variance, (0.01 * stated)**2)    # its lower limit
    return [float(np.sqrt(v * np.interp(index, grid, slope_variance) / fit.spread))
            for v, fit in zip(variance, fits, strict=True)]


@lru_cache(maxsize=32)
def _residual_properties(n: int) -> Floats:
    """
    Return properties of a line fitted to n rows of a first-order process, by CORRELATIONS: (4, c).

    For variance 1: mean square of residuals, variance of the slope; correlations at BLOCK_LAGS.
    """
    x = np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], -1)
    x /= np.linalg.norm(x, axis=0)
    to_residual = np.eye(n) - x @ x.T
    separation = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    table = []
    for correlation in CORRELATIONS:
        R = correlation**separation
        covariance = to_residual @ R @ to_residual
        table.append((np.trace(covariance) / n, x[:, 1] @ R @ x[:, 1],
                      *(np.trace(covariance, lag) / np.trace(covariance) for lag in BLOCK_LAGS)))
    return np.array(table).T


def counter_change_reasons(scales: Sections, t_fix: Floats,
                           distance: Floats) -> tuple[Reason, ...]:
    """
    Return TRACK_MISMATCH if the scale of sections changes once and is constant otherwise.

    scales : by section.   t_fix, distance : (k,) times of the fixes, s, and path length there, m.
    The section with the change may have any scale.
    """
    known = np.flatnonzero(np.isfinite(scales.ratio) & (scales.ratio > 0))
    log_scale, sigma = np.log(scales.ratio[known]), scales.sigma[known]
    changes: dict[float, tuple[int, float]] = {}      # scatter / change -> section, factor
    for k in range(1, len(known) - 1):
        sides = slice(k), slice(k + 1, None)
        before, after = (np.median(log_scale[side]) for side in sides)
        # a single section may be an outlier: its scatter is taken as that of its errors
        scatter = max(np.ptp(log_scale[side]) if len(log_scale[side]) > 1
                      else REMARK_SIGMAS * sigma[side][0] for side in sides)
        sigma_of_change = np.hypot(*(sigma[side].max() for side in sides))
        if abs(after - before) > max(TYRE_SPREAD, REMARK_SIGMAS * sigma_of_change,
                                     scatter / SIDE_SCATTER):
            changes.setdefault(scatter / abs(after - before), (
                int(known[k]), float(np.exp(before - after))))
    if not changes:
        return ()
    section, factor = changes[min(changes)]      # with the least scatter on both sides
    begin, end = np.interp([scales.begin[section], scales.end[section]], distance, t_fix)
    text = f'after t = {begin:.0f} to {end:.0f} s the odometer counts '
    if not 1 / MAX_DECODING < factor < MAX_DECODING:
        return (Reason(Code.TRACK_MISMATCH, text + f'{"far more" if factor > 1 else "far less"} '
                       'per metre between fixes than before. Likely cause: the position or the '
                       'counter is frozen', 'Check the receiver (static hold) and the counter. '
                       'Mark a leg before or after the change with --leg.'),)
    return (Reason(Code.TRACK_MISMATCH, text + f'{factor:.2f} times as much per metre between '
                   'fixes as before. Likely cause: a change of decoding (x1, x2, x4), unit or '
                   'gear', 'Check the odometer driver, and the fixes before and after the change. '
                   'Mark a leg before or after it with --leg.'),)


def window_scale(t_fix: Floats, fix_n: Floats, reckoned_n: Floats) -> Floats:
    """
    Return the scale for each of WINDOWS: (w, 4).

    Columns: length of the windows, s, scale of the fixes minus 1, its sigma, number of windows.

    t_fix : (k,) times of fixes, s, rising.   fix_n, reckoned_n : (k, 2 or more) positions by fixes
    and by dead reckoning, m. The sigma is from the scatter over parts of the leg (jackknife); it
    is too small if errors last longer than such a part.
    """
    rows = [_window_row(t_fix, fix_n[:, :2], reckoned_n[:, :2], length) for length in WINDOWS]
    return np.array([row for row in rows if row]) if any(rows) else NO_WINDOWS


def _window_row(t: Floats, fix: Floats, reckoned: Floats, length: float) -> tuple[float, ...]:
    """Return the row of ``window_scale`` for windows half a length apart, () if not determined."""
    begin = np.arange(t[0], t[-1] - length, length / 2) if len(t) else np.empty(0)
    # without the last fix: by rounding, the end of the last window may be after it
    first, last = np.searchsorted(t, begin), np.searchsorted(t[:-1], begin + length)
    # judgement: else some fixes are missing
    has_fixes = np.abs(t[last] - t[first] - length) < length / 4
    first, last = first[has_fixes], last[has_fixes]
    chord = reckoned[last] - reckoned[first]
    size = np.hypot(*chord.T)
    first, last, chord, size = (x[size > 0] for x in (first, last, chord, size))
    if len(first) < MIN_WINDOWS:
        return ()
    # length of the fixes' chord along the dead-reckoned one, minus the latter, m
    excess = (chord * (fix[last] - fix[first] - chord)).sum(axis=1) / size
    limit = 4 * max(robust_sigma(excess), 1e-9)       # statistical: one in 16,000
    excess = np.clip(excess, -limit, limit)
    # least squares of excess = (scale - 1) size, in total and without each part of the leg
    part = np.minimum((LEG_PARTS * (t[first] - t[0]) / (t[-1] - t[0])).astype(int), LEG_PARTS - 1)
    product, square = (np.bincount(part, x, LEG_PARTS) for x in (size * excess, size**2))
    # no part may have more than half of the weight
    if (square > 0).sum() < LEG_PARTS / 2 or square.max() > square.sum() / 2:
        return ()
    without_part = (product.sum() - product) / (square.sum() - square)
    scatter = ((without_part - without_part.mean())**2).sum()
    sigma = np.sqrt((LEG_PARTS - 1) / LEG_PARTS * scatter)
    return length, float(product.sum() / square.sum()), float(sigma), len(first)
