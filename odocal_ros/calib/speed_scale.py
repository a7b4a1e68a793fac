# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale of the uncorrected odometer by speed, against the fixes, in short cells of a leg."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import robust_sigma

# judgement: s, longest cell, in which the speed hardly varies, and shortest; intended number
LONGEST_CELL, SHORTEST_CELL, WANTED_CELLS = 5.0, 2.0, 40
SLOWEST_CELL = 0.2            # judgement: share of a high speed; below it fix errors dominate
MIN_CELLS, BINS = 12, 10    # judgement: cells for a result; points of a figure
MIN_SPREAD = 0.1    # judgement: of speeds over their mean; below it no offset is separable
NO_BINS = np.empty((0, 4))    # definition


@dataclass(frozen=True, eq=False)
class SpeedScale:
    """
    Scale by speed, with a fit: fixes = factor * odometer + offset * time, the odometer late.

    Each of the fit is (value, sigma), None if the speeds do not determine it.
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
    if len(t_fix) < MIN_CELLS or len(travel.t) < MIN_CELLS:
        return SpeedScale(NO_BINS)
    cell = min(LONGEST_CELL, max(SHORTEST_CELL, (t_fix[-1] - t_fix[0]) / WANTED_CELLS))
    # arange may reach beyond its end by rounding: [:-1] then gives the last fix
    knots = np.unique(np.searchsorted(t_fix[:-1], np.arange(t_fix[0], t_fix[-1], cell)))
    t = t_fix[knots]
    duration, path = np.diff(t), np.diff(distance[knots])
    chord, dead = (np.hypot(*np.diff(p[knots, :2], axis=0).T) for p in (fix_n, dead_n))
    rolled = np.diff(travel.at(t))
    speed = travel.at(t + 0.5) - travel.at(t - 0.5)       # mean of 1 s about each knot
    straight = dead > 0.8 * path      # judgement: in tighter turns a chord is too short
    fine = travel.at(t[:-1, None] + duration[:, None] * np.arange(0.0, 1.0, 0.1))
    step = np.diff(fine, axis=1)
    same_direction = (step > 0).all(axis=1) | (step < 0).all(axis=1)
    usable = (2 * cell > duration) & straight & (rolled != 0) & same_direction
    top_speed = float(np.percentile(path / duration, 90))      # robust to outliers
    usable &= path / duration > SLOWEST_CELL * top_speed
    if usable.sum() < MIN_CELLS:
        return SpeedScale(NO_BINS)
    length, change = chord[usable] * path[usable] / dead[usable], np.diff(np.abs(speed))[usable]
    rolled, duration = np.abs(rolled[usable]), duration[usable]
    fit, used = _fit_cells(length, rolled, duration, change)
    return SpeedScale(_bins(length[used], rolled[used], duration[used]), *fit)


def _fit_cells(length: Floats, rolled: Floats, duration: Floats, change: Floats
               ) -> tuple[tuple[tuple[float, float], ...], Bools]:
    """
    Return factor, offset and lag of ``SpeedScale``, () if not determined, and mask of used cells.

    length, rolled, duration, change : (k,) by the fixes, m, by the odometer, units, time, s, and
    change of the odometer speed, units/s.
    """
    used: Bools = np.ones(len(length), bool)
    mean_speed, scale = length / duration, length.sum() / rolled.sum()
    X = np.stack([rolled, duration, scale * change], -1)
    for _ in range(3):      # iterations of outlier rejection
        x, *_ = np.linalg.lstsq(X[used], length[used], rcond=None)
        residual = np.abs(length - X @ x)
        sigma = robust_sigma(residual[used])
        used = np.asarray(residual <= 4 * max(sigma, 1e-6))     # statistical: one in 16,000
    spread = float(np.std(mean_speed[used]) / np.mean(mean_speed[used]))
    if used.sum() < MIN_CELLS or spread < MIN_SPREAD:
        return (), used
    variance = float(np.sum((length - X @ x)[used]**2)) / max(int(used.sum()) - 3, 1)
    sigmas = np.sqrt(np.diag(np.linalg.pinv(X[used].T @ X[used])) * variance)
    return tuple((float(value), float(s)) for value, s in zip(x, sigmas, strict=True)), used


def _bins(length: Floats, rolled: Floats, duration: Floats) -> Floats:
    """Return ``SpeedScale.bins`` of cells, each with the same number of cells: (b, 4)."""
    # sorted by odometer speed: by the fixes they would be sorted by fix errors
    order, scale = np.argsort(rolled / duration, kind='stable'), float(length.sum() / rolled.sum())
    rows = []
    for part in np.array_split(order, min(BINS, len(order) // 4)):
        travel, n = rolled[part].sum(), len(part)
        ratio = float(length[part].sum() / travel)
        square = np.sum((length[part] - ratio * rolled[part])**2)
        rows.append((scale * float(travel / duration[part].sum()), ratio,
                     float(np.sqrt(square * n / (n - 1)) / travel), n))
    return np.array(rows)
