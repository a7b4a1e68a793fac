# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale by speed: the uncorrected odometer compared with the fixes in short cells of a leg."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.statistics import robust_sigma

# judgement: s, longest cell, in which the speed hardly varies, and shortest; intended number
LONGEST_CELL, SHORTEST_CELL, WANTED_CELLS = 5.0, 2.0, 40
SLOWEST_CELL = 0.2            # judgement: share of a high speed; below it fix errors dominate
FEWEST_CELLS, BINS = 12, 10    # judgement: cells for a result; points of a figure
# judgement: spread of the speeds over their mean, below which an offset is not separable
LEAST_SPREAD = 0.1
NO_BINS = np.empty((0, 4))    # definition: no bins


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
