"""Standstill: when the vehicle stands, from odometer and gyro."""

import numpy as np

CELL = 0.1            # s, grid of the detector
WINDOW = 0.5          # s, each side
MOVE = 0.03           # m, travel within the window that still counts as standing
TURN = 0.02           # rad/s, wander of the gyro that still counts as standing
CREEP = 0.02          # m/s, mean speed at which a long slow stretch is no standstill


def standstills(t_imu, w_b, travel, metres_per_unit, shortest):
    """
    Find when the vehicle stands.

    Parameters
    ----------
    t_imu, w_b : (n,), (n, 3) arrays
        Imu times, s, and turn rates, rad/s, bias and all.
    travel : Travel
        Odometer travel.
    metres_per_unit : float
        Rough scale of it.
    shortest : float
        Least duration, s.

    Returns
    -------
    (k, 2) array of begin and end times, s, in order. The edges lie inside the true standstill by
    up to the window: a slow start is cut off, never included.

    """
    if len(t_imu) < 2 or len(travel.t) < 2:
        return np.empty((0, 2))
    t0, t1 = max(t_imu[0], travel.t[0]), min(t_imu[-1], travel.t[-1])
    if t1 - t0 < shortest:
        return np.empty((0, 2))
    edges = np.linspace(t0, t1, max(2, round((t1 - t0) / CELL)) + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    quiet = _still_wheels(middle, travel, metres_per_unit) & _still_gyro(edges, t_imu, w_b)
    steps = np.diff(np.concatenate([[False], quiet, [False]]).astype(int))
    spans = np.stack([edges[np.flatnonzero(steps == 1)], edges[np.flatnonzero(steps == -1)]], -1)
    moved = np.abs(travel.at(spans[:, 1]) - travel.at(spans[:, 0])) * metres_per_unit
    length = spans[:, 1] - spans[:, 0]
    return spans[(length >= shortest) & (moved <= CREEP * length + MOVE)]


def _still_wheels(middle, travel, metres_per_unit):
    """Tell where travel within the window stays within MOVE and a count or so of jitter."""
    allowed = max(MOVE, 1.5 * travel.quantum * metres_per_unit)
    # range of the travel in the window by a few probes, so that rocking to and fro is seen
    probes = [travel.at(middle + x) for x in np.linspace(-WINDOW, WINDOW, 5)]
    reach = np.max(probes, axis=0) - np.min(probes, axis=0)
    return reach * abs(metres_per_unit) <= allowed


def _still_gyro(edges, t_imu, w_b):
    """Tell where the mean turn rate of the cells around wanders by less than TURN."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(
        (w_b[:-1] + w_b[1:]) / 2 * np.diff(t_imu)[:, None], axis=0)])
    angle = np.stack([np.interp(edges, t_imu, total[:, k]) for k in range(3)], -1)
    rate = np.diff(angle, axis=0) / np.diff(edges)[:, None]
    reach = round(WINDOW / CELL)
    padded = np.pad(rate, ((reach, reach), (0, 0)), mode='edge')
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)
    return (windows.std(axis=-1) < TURN).all(axis=-1)
