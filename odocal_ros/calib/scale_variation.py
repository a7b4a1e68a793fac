# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Scale of the fixes relative to dead reckoning: by section, by length of a window, and by speed.

The scale of sections shows a change of the odometer scale during the drive. If fix errors do not
depend on the motion, the scale is the same for windows of all lengths. A receiver that filters,
dead-reckons or uses an odometer, and fixes with late stamps, have errors that depend on the motion
over seconds but not over minutes: short windows then differ. The scale by speed compares the
uncorrected odometer with the fixes in short cells of a leg.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from odocal_ros.data.arrays import Bools, Complexes, Floats
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS, TYRE_SPREAD

# lags of the correlation of residuals, in blocks: judgement, the next block and one at which
# additional white noise does not hide it
BLOCK_LAGS = (1, 3)
# rotation and scale; residuals, m; sum of squared distances from the middle, m^2
Similarity = tuple[np.complexfloating, Complexes, float]
# judgement: grid of the correlation from block to block, finer where the sigma of a scale grows
MEMORIES = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.88, 0.93, 0.96, 0.98, 0.99])
SIDE_SCATTER = 0.25    # judgement: share of the change by which sections on one side may differ
WINDOWS = 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0     # s, definition
PARTS, FEWEST_WINDOWS = 8, 12      # judgement: parts of the leg for a sigma; windows for a result
NO_WINDOWS = np.empty((0, 4))    # definition
# judgement: s, longest cell, in which the speed hardly varies, and shortest; intended number
LONGEST_CELL, SHORTEST_CELL, WANTED_CELLS = 5.0, 2.0, 40
SLOWEST_CELL = 0.2            # judgement: share of a high speed; below it fix errors dominate
FEWEST_CELLS, BINS = 12, 10    # judgement: cells for a result; points of a figure
# judgement: spread of the speeds over their mean, below which an offset is not separable
LEAST_SPREAD = 0.1
NO_BINS = np.empty((0, 4))    # definition: no bins


@dataclass(frozen=True, eq=False)
class Sections:
    """Scale by section, (k,): length by the fixes over length dead reckoned as calibrated."""

    begin: Floats  # m, path length
    end: Floats    # m
    ratio: Floats  # NaN: not determined by the fixes
    sigma: Floats  # of the ratio


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
    for i, found in zip(fits, _scale_sigmas(list(fits.values()), float(np.median(sigma))),
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


def _scale_sigmas(fits: list[Similarity], stated: float) -> list[float]:
    """Return the sigma of each scale."""
    if not fits:
        return []
    n = int(np.median([len(left) for _, left, _ in fits]))
    residual_power, widening, *correlations = _residual_properties(n)
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
def _residual_properties(n: int) -> Floats:
    """Return power, slope variance, correlations of residuals of a line of n rows, by memory."""
    x = np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], -1)
    x /= np.linalg.norm(x, axis=0)
    off = np.eye(n) - x @ x.T
    separation = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    table = []
    for memory in MEMORIES:
        R = memory**separation
        left = off @ R @ off
        table.append((np.trace(left) / n, x[:, 1] @ R @ x[:, 1],
                      *(np.trace(left, lag) / np.trace(left) for lag in BLOCK_LAGS)))
    return np.array(table).T


def counter_change_reasons(parts: Sections, t_fix: Floats, fix_distance: Floats) -> tuple[Reason,
                                                                                          ...]:
    """
    Return TRACK_MISMATCH if the scale of sections changes once and is constant otherwise.

    parts : scale by section.   t_fix, fix_distance : (k,) times of the fixes, s, and path length
    there, m. The section with the change may have any scale.
    """
    known = np.flatnonzero(np.isfinite(parts.ratio) & (parts.ratio > 0))
    log, sigma = np.log(parts.ratio[known]), parts.sigma[known]
    found = []
    for k in range(1, len(known) - 1):
        sides = [log[:k], log[k + 1:]]
        before, after = (np.median(side) for side in sides)
        separation = max(np.ptp(side) for side in sides)
        sigma_of_change = np.hypot(*(sigma[rows].max() for rows in (slice(k), slice(k + 1, None))))
        if abs(after - before) > max(TYRE_SPREAD, REMARK_SIGMAS * sigma_of_change, separation
                                     / SIDE_SCATTER):
            found.append((separation / abs(after - before), k, float(np.exp(before - after))))
    if not found:
        return ()
    _, k, factor = min(found)
    begin, end = np.interp([parts.begin[known[k]], parts.end[known[k]]], fix_distance, t_fix)
    return (Reason(Code.TRACK_MISMATCH, 'the odometer scale changes: it counts '
                   f'{factor:.2f} times as much per metre after t = {begin:.0f} to {end:.0f} s as '
                   'before', 'Check the driver for a change of decoding (x1, x2, x4), unit or '
                   'gear. Mark a leg on one side of the change with --leg.'),)


def window_scale(t_fix: Floats, fix_n: Floats, dead_n: Floats) -> Floats:
    """
    Return length of the windows, s, scale - 1 of the fixes, its sigma, and windows: (w, 4).

    t_fix : (k,) times of fixes, s, rising.   fix_n, dead_n : (k, 2 or more) positions by fixes and
    by dead reckoning, m. The sigma is by the scatter over parts of the leg (jackknife); it is too
    small if errors last longer than such a part.
    """
    rows = [(length, *found) for length in WINDOWS
            if (found := _scale(t_fix, fix_n[:, :2], dead_n[:, :2], length))]
    return np.array(rows) if rows else NO_WINDOWS


def _scale(t: Floats, fix: Floats, dead: Floats, length: float) -> tuple[float, float, int] | None:
    """Return scale - 1, its sigma and the number of windows of a length, half a length apart."""
    begin = np.arange(t[0], t[-1] - length, length / 2) if len(t) else np.empty(0)
    # without the last fix: by rounding, the end of the last window may be after it
    i, j = np.searchsorted(t, begin), np.searchsorted(t[:-1], begin + length)
    near = np.abs(t[j] - t[i] - length) < length / 4     # judgement: else fixes are missing
    i, j = i[near], j[near]
    chord = dead[j] - dead[i]
    size = np.hypot(*chord.T)
    i, j, chord, size = (x[size > 0] for x in (i, j, chord, size))
    if len(i) < FEWEST_WINDOWS:
        return None
    along = (chord * (fix[j] - fix[i] - chord)).sum(axis=1) / size
    most = 4 * max(robust_sigma(along), 1e-9)       # statistical: one in 16,000
    along = np.clip(along, -most, most)
    block = np.minimum((PARTS * (t[i] - t[0]) / (t[-1] - t[0])).astype(int), PARTS - 1)
    top, bottom = (np.bincount(block, x, PARTS) for x in (size * along, size**2))
    # no block may have more than half of the weight
    if (bottom > 0).sum() < PARTS / 2 or bottom.max() > bottom.sum() / 2:
        return None
    left = (top.sum() - top) / (bottom.sum() - bottom)
    sigma = np.sqrt((PARTS - 1) / PARTS * ((left - left.mean())**2).sum())
    return float(top.sum() / bottom.sum()), float(sigma), len(i)


@dataclass(frozen=True, eq=False)
class SpeedScale:
    """
    Ratio of the distances of fixes and odometer by speed, with a fit (value, sigma).

    reference = factor * odometer + offset * time, with the odometer late by the lag; None if the
    speeds do not determine them.
    """

    bins: Floats  # (b, 4) speed m/s, ratio in m per unit, its sigma, number of cells
    factor: tuple[float, float] | None = None  # m per unit
    offset: tuple[float, float] | None = None  # m/s
    lag: tuple[float, float] | None = None  # s


def speed_scale(t_fix: Floats, fix_n: Floats, dead_n: Floats, distance: Floats,
                travel: Travel) -> SpeedScale:
    """
    Return the scale against speed of a leg.

    t_fix : (k,) times of fixes, s, rising.   fix_n, dead_n : (k, 2 or more) positions by fixes and
    by dead reckoning, m.   distance : (k,) path length by dead reckoning, m; over the chord by
    ``dead_n`` it converts chords to path lengths.   travel : of the uncorrected odometer.
    """
    if len(t_fix) < FEWEST_CELLS or len(travel.t) < FEWEST_CELLS:
        return SpeedScale(NO_BINS)
    cell = min(LONGEST_CELL, max(SHORTEST_CELL, (t_fix[-1] - t_fix[0]) / WANTED_CELLS))
    # arange may reach beyond its end by rounding: [:-1] then gives the last fix
    knots = np.unique(np.searchsorted(t_fix[:-1], np.arange(t_fix[0], t_fix[-1], cell)))
    t = t_fix[knots]
    T, path = np.diff(t), np.diff(distance[knots])
    chord, dead = (np.hypot(*np.diff(p[knots, :2], axis=0).T) for p in (fix_n, dead_n))
    rolled = np.diff(travel.at(t))
    half = 0.5        # s before and after a knot, for the mean speed there
    speed = (travel.at(t + half) - travel.at(t - half)) / (2 * half)
    straight = dead > 0.8 * path      # judgement: in tighter turns a chord is too short
    fine = travel.at(t[:-1, None] + T[:, None] * np.arange(0.0, 1.0, 0.1))
    step = np.diff(fine, axis=1)
    one_way = (step > 0).all(axis=1) | (step < 0).all(axis=1)
    good = (2 * cell > T) & straight & (rolled != 0) & one_way
    top = float(np.percentile(path / T, 90))      # robust to outliers
    good &= path / T > SLOWEST_CELL * top
    if good.sum() < FEWEST_CELLS:
        return SpeedScale(NO_BINS)
    length = chord[good] * path[good] / dead[good]
    rolled, change, T = np.abs(rolled[good]), np.diff(np.abs(speed))[good], T[good]
    fit, used = _fit(length, rolled, T, change)
    return SpeedScale(_bins(length[used], rolled[used], T[used]), *fit)


def _fit(length: Floats, rolled: Floats, T: Floats, change: Floats
         ) -> tuple[tuple[tuple[float, float], ...], Bools]:
    """Return factor, offset and lag with sigmas, empty if not determined; and cells in use."""
    used: Bools = np.ones(len(length), bool)
    mean_speed = length / T
    scale = float(length.sum() / rolled.sum())
    X = np.stack([rolled, T, scale * change], -1)
    for _ in range(3):      # iterations of outlier rejection
        x, *_ = np.linalg.lstsq(X[used], length[used], rcond=None)
        off = np.abs(length - X @ x)
        sigma = robust_sigma(off[used])
        used = np.asarray(off <= 4 * max(sigma, 1e-6))     # statistical: one in 16,000
    spread = float(np.std(mean_speed[used]) / np.mean(mean_speed[used]))
    if used.sum() < FEWEST_CELLS or spread < LEAST_SPREAD:
        return (), used
    variance = float(np.sum((length - X @ x)[used]**2)) / max(int(used.sum()) - 3, 1)
    root = np.sqrt(np.diag(np.linalg.pinv(X[used].T @ X[used])) * variance)
    return tuple((float(a), float(s)) for a, s in zip(x, root, strict=True)), used


def _bins(length: Floats, rolled: Floats, T: Floats) -> Floats:
    """Return speed, ratio, its sigma and number of cells, for groups of equal numbers of cells."""
    # sorted by odometer speed: by the fixes they would be sorted by fix errors
    order, scale = np.argsort(rolled / T, kind='stable'), float(length.sum() / rolled.sum())
    rows = []
    for part in np.array_split(order, min(BINS, len(order) // 4)):
        ratio = float(length[part].sum() / rolled[part].sum())
        left = length[part] - ratio * rolled[part]
        sigma = float(np.sqrt(np.sum(left**2) * len(part) / (len(part) - 1)) / rolled[part].sum())
        speed = scale * float(rolled[part].sum() / T[part].sum())
        rows.append((speed, ratio, sigma, len(part)))
    return np.array(rows)
