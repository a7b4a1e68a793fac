# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of standstills, from which alignment, gyro bias and legs start.

A standstill is an interval in which neither the turn rates nor the travel of the odometer show
motion. The detector divides the time into cells, and tests a window around each.
"""

from functools import reduce

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, map_windows, reduce_columns, running_sum, runs
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import integral_at

REST_CELL = 0.1       # s, judgement: length of a cell of the detector
REST_WINDOW = 0.5     # s, judgement: reach of the window of a cell to each side
REST_TRAVEL = 0.03    # m, judgement: largest travel in a window at rest
REST_TURN = 0.02      # rad/s, judgement: largest drift of the gyro at rest
MAX_BIAS = 0.12      # rad/s, each axis, physical: largest bias of a gyro (cheap phones: 0.1)


def standstills(t_imu: Floats, w_b: Floats, travel: Travel, metres_per_unit: float,
                shortest: float) -> Floats:
    """
    Return begin and end of the standstills in order: (k, 2) s.

    t_imu, w_b : (n,), (n, 3) s, and turn rates with bias, rad/s.   metres_per_unit : approximate
    scale, above 0.   shortest : least duration, s.   The edges are up to REST_WINDOW inside the
    true standstill; if the vehicle starts very slowly, that motion is included.
    """
    if len(t_imu) < 2 or len(travel.t) < 2:
        return np.empty((0, 2))
    t0, t1 = max(t_imu[0], travel.t[0]), min(t_imu[-1], travel.t[-1])
    if t1 - t0 < shortest:
        return np.empty((0, 2))
    edges = np.linspace(t0, t1, max(2, round((t1 - t0) / REST_CELL)) + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    rate, steady = _steady_rates(edges, t_imu, w_b)
    at_rest = _wheels_at_rest(middle, travel, metres_per_unit) & steady
    at_rest &= _has_lowest_rate(rate, at_rest, edges, shortest)
    spans = _spans(at_rest, edges, shortest)
    path = np.abs(travel.at(spans[:, 1]) - travel.at(spans[:, 0])) * metres_per_unit
    speed_limit = 0.02    # m/s, largest mean speed of a long standstill
    return spans[path <= speed_limit * (spans[:, 1] - spans[:, 0])
                 + _travel_limit(travel, metres_per_unit)]


def _travel_limit(travel: Travel, metres_per_unit: float) -> float:
    """Return the largest travel in a window at rest, m: REST_TRAVEL, or jitter of a count."""
    count = travel.quantum * metres_per_unit
    coarse_count = 0.5    # m, larger counts are coarse
    # one count of a coarse counter (few per turn of the wheel) is motion, not jitter
    return max(REST_TRAVEL, (1.5 if count <= coarse_count else 0.5) * count)


def _spans(at_rest: Bools, edges: Floats, shortest: float) -> Floats:
    """Return begin and end of the runs of cells at rest of ``shortest`` s or more: (k, 2)."""
    spans: Floats = edges[runs(at_rest)]
    return spans[spans[:, 1] - spans[:, 0] >= shortest - 1e-9]


def _wheels_at_rest(middle: Floats, travel: Travel, metres_per_unit: float) -> Bools:
    """Return a mask of cells with little travel around their middles: (m,)."""
    # range of the travel at a few times in the window, so that rocking is detected
    samples = [travel.at(middle + x) for x in np.linspace(-REST_WINDOW, REST_WINDOW, 5)]
    distance = np.max(samples, axis=0) - np.min(samples, axis=0)
    return np.asarray(distance * metres_per_unit <= _travel_limit(travel, metres_per_unit))


def _steady_rates(edges: Floats, t_imu: Floats, w_b: Floats) -> tuple[Floats, Bools]:
    """Return the mean turn rate around each cell, (m, 3), and a mask of scatter < REST_TURN."""
    rate = np.diff(integral_at(edges, t_imu, w_b), axis=0) / np.diff(edges)[:, None]
    reach = round(REST_WINDOW / REST_CELL)
    padded = np.pad(rate, ((reach, reach), (0, 0)), mode='edge')
    shifted = [padded[k:k + len(rate)] for k in range(2 * reach + 1)]
    mean = reduce(np.add, shifted) / len(shifted)
    scatter = np.sqrt(reduce(np.add, [(x - mean)**2 for x in shifted]) / len(shifted))
    has_data = np.ones(len(rate), bool)
    if map_windows(lambda t: np.diff(t) > REST_WINDOW, t_imu).any():
        dt = np.diff(t_imu)
        time_in_gaps = running_sum(np.where(dt > REST_WINDOW, dt, 0.0))
        has_data = np.diff(np.interp(edges, t_imu, time_in_gaps)) == 0
    return mean, reduce_columns(np.logical_and, scatter < REST_TURN) & has_data


def _has_lowest_rate(rate: Floats, at_rest: Bools, edges: Floats, shortest: float) -> Bools:
    """Return a mask of cells with the lowest steady turn rate, which is the bias at rest."""
    medians = [np.median(rate[(edges[:-1] >= a) & (edges[1:] <= b)], axis=0)
               for a, b in _spans(at_rest, edges, shortest)]
    if not medians:
        return at_rest
    bias = min(medians, key=np.linalg.norm)
    if np.abs(bias).max() > MAX_BIAS:
        return np.zeros_like(at_rest)
    return reduce_columns(np.logical_and, np.abs(rate - bias) < REST_TURN)
