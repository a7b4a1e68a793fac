# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale of the uncorrected odometer by speed, against the fixes, in short cells of a leg."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import robust_sigma

LONGEST_CELL = 5.0      # s, judgement: the speed hardly varies in it
SHORTEST_CELL = 2.0     # s, judgement
WANTED_CELLS = 40       # judgement: intended number of cells of a leg
SLOWEST_CELL = 0.2      # judgement: share of the 90th percentile of speed; below, fixes are noisy
MIN_CELLS = 12          # judgement: for a result
BINS = 10               # judgement: points of a figure
MIN_SPEED_VARIATION = 0.1    # judgement: sigma of speeds over their mean; below it no offset shows
NO_BINS = np.empty((0, 4))    # definition: ``SpeedScale.bins`` of a leg without a result


@dataclass(frozen=True, eq=False)
class SpeedScale:
    """
    Scale by speed, and a fit to the cells.

    Fit: distance of the fixes = factor * odometer travel + offset * time + lag * change of speed;
    each value with its sigma, None if the speeds do not determine it.
    """

    bins: Floats  # (b, 4) speed m/s, ratio in m per unit, its sigma, number of cells
    factor: tuple[float, float] | None = None  # m per unit
    offset: tuple[float, float] | None = None  # m/s
    lag: tuple[float, float] | None = None  # s


def speed_scale(t_fix: Floats, fix_n: Floats, reckoned_n: Floats, distance: Floats,
                travel: Travel) -> SpeedScale:
    """
    Return the scale against speed of a leg.

    t_fix : (k,) times of fixes, s, rising.   fix_n, reckoned_n : (k, 2 or more) positions by fixes
    and by dead reckoning, m.   distance : (k,) path length by dead reckoning, m; its ratio to the
    chord of ``reckoned_n`` converts chords into path lengths.   travel : of the uncorrected
    odometer.
    """
    if len(t_fix) < MIN_CELLS or len(travel.t) < MIN_CELLS:
        return SpeedScale(NO_BINS)
    cell = min(LONGEST_CELL, max(SHORTEST_CELL, (t_fix[-1] - t_fix[0]) / WANTED_CELLS))
    # arange may reach beyond its end by rounding: [:-1] then gives the last fix
    knots = np.unique(np.searchsorted(t_fix[:-1], np.arange(t_fix[0], t_fix[-1], cell)))
    t = t_fix[knots]
    duration, path = np.diff(t), np.diff(distance[knots])
    chord, reckoned = (np.hypot(*np.diff(p[knots, :2], axis=0).T) for p in (fix_n, reckoned_n))
    odometer_travel = np.diff(travel.at(t))
    speed = travel.at(t + 0.5) - travel.at(t - 0.5)       # mean of 1 s about each knot
    is_straight = reckoned > 0.8 * path      # judgement: in tighter turns a chord is too short
    # travel in each tenth of a cell
    step = np.diff(travel.at(t[:-1, None] + duration[:, None] * np.arange(0.0, 1.0, 0.1)), axis=1)
    same_direction = (step > 0).all(axis=1) | (step < 0).all(axis=1)
    has_no_gap = 2 * cell > duration
    usable = has_no_gap & is_straight & (odometer_travel != 0) & same_direction
    top_speed = float(np.percentile(path / duration, 90))      # robust to outliers
    usable &= path / duration > SLOWEST_CELL * top_speed
    if usable.sum() < MIN_CELLS:
        return SpeedScale(NO_BINS)
    length = chord[usable] * path[usable] / reckoned[usable]
    speed_change = np.diff(np.abs(speed))[usable]
    odometer_travel, duration = np.abs(odometer_travel[usable]), duration[usable]
    fit, used = _fit_cells(length, odometer_travel, duration, speed_change)
    return SpeedScale(_bins(length[used], odometer_travel[used], duration[used]), *fit)


def _fit_cells(length: Floats, odometer_travel: Floats, duration: Floats, speed_change: Floats
               ) -> tuple[tuple[tuple[float, float], ...], Bools]:
    """
    Return factor, offset and lag of ``SpeedScale``, () if not determined, and mask of used cells.

    length, odometer_travel, duration, speed_change : (k,) by the fixes, m, by the odometer, units,
    time, s, and change of the odometer speed, units/s.
    """
    used: Bools = np.ones(len(length), bool)
    mean_speed, scale = length / duration, length.sum() / odometer_travel.sum()
    X = np.stack([odometer_travel, duration, scale * speed_change], -1)
    for _ in range(3):      # iterations of outlier rejection
        x, *_ = np.linalg.lstsq(X[used], length[used], rcond=None)
        deviation = np.abs(length - X @ x)
        sigma = robust_sigma(deviation[used])
        used = np.asarray(deviation <= 4 * max(sigma, 1e-6))     # statistical: one in 16,000
    variation = float(np.std(mean_speed[used]) / np.mean(mean_speed[used]))
    if used.sum() < MIN_CELLS or variation < MIN_SPEED_VARIATION:
        return (), used
    variance = float(np.sum((length - X @ x)[used]**2)) / max(int(used.sum()) - 3, 1)
    sigmas = np.sqrt(np.diag(np.linalg.pinv(X[used].T @ X[used])) * variance)
    return tuple((float(value), float(s)) for value, s in zip(x, sigmas, strict=True)), used


def _bins(length: Floats, odometer_travel: Floats, duration: Floats) -> Floats:
    """Return ``SpeedScale.bins`` of cells, each with the same number of cells: (b, 4)."""
    # sorted by odometer speed: by the fixes they would be sorted by fix errors
    order = np.argsort(odometer_travel / duration, kind='stable')
    scale = float(length.sum() / odometer_travel.sum())
    rows = []
    for part in np.array_split(order, min(BINS, len(order) // 4)):
        travel, n = odometer_travel[part].sum(), len(part)
        ratio = float(length[part].sum() / travel)
        square = np.sum((length[part] - ratio * odometer_travel[part])**2)
        rows.append((scale * float(travel / duration[part].sum()), ratio,
                     float(np.sqrt(square * n / (n - 1)) / travel), n))
    return np.array(rows)
