# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Faults of two wheels, detected with the gyro: swapped, one slipping, different counters.

The paths of the two wheels differ by the track width times the turn. The remaining difference is
rounding and gyro noise, millimetres over seconds; a wheel that spins or slides alone exceeds it by
centimetres. With the acceleration of the IMU alone the limit is half a metre.

The residual is the path of the right wheel minus its regression on that of the left one
(wheel_pair_regression.py). A slip is a step of the residual; the acceleration shows which wheel
slipped.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from odocal_ros.calib import slip, wheel_pair_regression as regression
from odocal_ros.calib.wheel_pair_regression import MEAN_STEPS, WHOLE_DRIVE_SIGMAS
from odocal_ros.data.arrays import Bools, Floats, running_sum, runs
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Reason
from odocal_ros.screening.inputs import ImuRows
from odocal_ros.screening.wheel_faults import WheelPair, wheels_on_grid

# steps between the ends of windows: slips of up to 1, 3, 8, 20, 50 s; others are detected too.
# Judgement
SLIP_SPANS = (10, 30, 80, 200, 500)
# 1 sigma of the difference of two wheels on real ground without a slip. Physical, judgement: m in
# any window (stones, tyres); share of track width times turn (scrub, camber, the gyro's scale)
GROUND_SIGMA, TURN_SHARE = 0.005, 0.01


class Event(NamedTuple):
    """A step of the residual."""

    begin: float    # s
    end: float      # s
    size: float     # m, right minus left


class Window(NamedTuple):
    """Jumps of the mean residual over windows of one length, which begin at each row: (n,)."""

    span: int            # rows from the first to the last mean
    jump: Floats         # (n,) m, last mean minus first mean
    limit: Floats        # (n,) m, of jumps by chance
    is_large: Bools      # (n,) True beyond the limit


def wheel_faults(axle: Sequence[Travel], imu: ImuRows, t_stop: float, track: Track,
                 latitude: float, metres_per_unit: float, track_width: float = 0.0,
                 uncertain_t: Sequence[float] | Floats = (), max_deviation: float = 0.35,
                 wheel_count: int = 2) -> tuple[tuple[Reason, ...], slip.WheelSlips]:
    """
    Return the faults of two counting wheels by the gyro, and the slips of one of them.

    axle : left and right wheel.   t_stop : s, stop mark.   track : dead reckoned with the mean of
    both, for attitudes.   latitude : rad.   metres_per_unit : approximate scale of the mean.
    track_width : m, 0 unknown.   uncertain_t : (d,) s, times of travel that is uncertain for
    other reasons (gaps, resets).   max_deviation : limit of the ratio of the counts minus one.
    wheel_count : number of wheels in the mean.
    """
    pair = wheels_on_grid(axle, imu, t_stop, slip.SLIP_GRID, uncertain_t)
    if pair is None or not metres_per_unit:
        return (), slip.NO_SLIPS
    pair = regression.without_gyro_drift(pair)
    regressors = regression.right_path_regressors(pair, metres_per_unit)
    fit = regression.fit_right_path(pair, regressors, metres_per_unit)
    if fit is None:
        return (), slip.NO_SLIPS
    coefficients, covariance = fit
    ratio = coefficients[0]                                 # right counts over left ones
    right_scale = metres_per_unit * (1 + 1 / ratio) / 2     # m per count of the right wheel
    fitted_width, width_sigma = coefficients[1] * right_scale, np.sqrt(
        covariance[1, 1]) * right_scale                     # m
    width = track_width if track_width else abs(fitted_width)
    reasons = regression.side_reasons(pair, fitted_width, width_sigma, track_width)
    reasons += regression.counter_reasons(pair, ratio, width, max_deviation)
    residual = (pair.right - regressors @ coefficients) * right_scale
    events, slow_events = _find_events(pair, residual, right_scale * (1 + ratio) / 2, width)
    change_reasons, change = regression.find_ratio_change(
        _without_slips(pair, events), regressors, metres_per_unit, wheel_count)
    reasons += change_reasons
    # a slow event is a slip; if the ratio changes, only one that is twice as steep
    events = sorted(events + slow_events)
    if change:
        steep = 2 * abs(change) * metres_per_unit
        events = [event for event in events if abs(_slope(pair, event)) > steep]
    if not events:
        return reasons, replace(slip.NO_SLIPS, change=change)
    mean_path = (pair.left * ratio + pair.right) / 2 * right_scale
    begin, end, size = np.transpose(events)
    wheel = np.array([_find_wheel(pair, mean_path, imu, track, latitude, event)
                      for event in events])
    # if the left wheel spins, right minus left is negative
    slips = slip.WheelSlips(begin, end, np.where(wheel < 0, -size, size), wheel, change)
    return reasons + slip.wheel_slip_reason(slips, pair.names), slips


def _without_slope(pair: WheelPair, residual: Floats, quantum_m: float) -> Floats:
    """Return the residual, (n,) m, without its usual slope over the path."""
    path, n = _mean_path(pair), 200     # steps of a slope, 20 s: longer than most slips
    distance, rise = path[n:] - path[:-n], residual[n:] - residual[:-n]
    if len(distance) < n:
        return residual
    moves = distance > max(np.median(distance) / 2, 2 * pair.quantum)
    slope = np.median(rise[moves] / distance[moves]) if moves.any() else 0.0
    # a slope that rounding can cause at a steady speed, two counts over a window, is not removed
    rounding_slope = 2 * quantum_m * (pair.quantum > 0) / max(np.median(distance), 1e-9)
    return np.asarray(residual - np.sign(slope) * max(abs(slope) - rounding_slope, 0.0) * path)


def _without_slips(pair: WheelPair, events: list[Event]) -> WheelPair:
    """Return the wheels, with the cells of slips marked as incomplete."""
    is_complete = pair.is_complete.copy()
    margin = 2.0       # s each side, possibly part of the slip
    for event in events:
        is_complete &= (pair.t[1:] < event.begin - margin) | (pair.t[:-1] > event.end + margin)
    return replace(pair, is_complete=is_complete)


def _find_events(pair: WheelPair, residual: Floats, quantum_m: float,
                 width: float) -> tuple[list[Event], list[Event]]:
    """Return the steps of the residual, (n,) m, that end, and those that may change the ratio."""
    # a step is a jump between two means of the residual, larger than by chance; the time between
    # the means is one of SLIP_SPANS. quantum_m, width : size of a count, track width, m
    residual = _without_slope(pair, residual, quantum_m)
    total = running_sum(residual)
    mean = (total[MEAN_STEPS:] - total[:-MEAN_STEPS]) / MEAN_STEPS
    incomplete = running_sum(~pair.is_complete)
    significant = np.zeros(len(pair.t), bool)
    windows = []
    for span in (gap + MEAN_STEPS for gap in SLIP_SPANS):
        jump = mean[span:] - mean[:-span]
        if len(jump) < span:
            continue
        limit = _jump_limits(pair, jump, span, quantum_m * (pair.quantum > 0), width)
        has_gap = incomplete[span + MEAN_STEPS - 1:][:len(jump)] != incomplete[:len(jump)]
        is_large = (np.abs(jump) > limit) & ~has_gap
        for k in np.flatnonzero(is_large):
            significant[k + MEAN_STEPS:k + span] = True
        windows.append(Window(span, jump, limit, is_large))
    finished: list[Event] = []
    slow: list[Event] = []
    for begin, end in runs(significant):
        event = _measure_event(pair, residual, windows, begin, end)
        (finished if _is_finished(pair, residual, event) else slow).append(event)
    return finished, slow


def _is_finished(pair: WheelPair, residual: Floats, event: Event) -> bool:
    """Return True if a slip ends: it is short, or its slope is absent before and after it."""
    path = _mean_path(pair)
    times = [event.begin, event.end]
    begin, end = np.interp(times, pair.t, path)
    if end - begin < path[-1] / 16:      # half a step of ``find_ratio_change``
        return True
    begin_row, end_row = np.searchsorted(pair.t, times).clip(0, len(path) - 1)
    min_rise = 0.1      # m, observable
    for first, last in ((0, begin_row), (end_row, len(path) - 1)):
        expected = _slope(pair, event) * (path[last] - path[first])
        rise = residual[last] - residual[first]
        if abs(expected) < min_rise or abs(rise) > abs(expected) / 2:
            return False
    return True


def _slope(pair: WheelPair, event: Event) -> float:
    """Return the size of a slip per path length, from a tenth to nine tenths of its size."""
    begin, end = np.interp([event.begin, event.end], pair.t, _mean_path(pair))
    return float(0.8 * event.size / max(end - begin, 1e-9))


def _mean_path(pair: WheelPair) -> Floats:
    """Return the path length of the mean of both wheels up to each edge, scale units: (n,)."""
    return running_sum(np.abs(np.diff(pair.left + pair.right)) / 2)


def _jump_limits(pair: WheelPair, jump: Floats, span: int, quantum_m: float,
                 width: float) -> Floats:
    """Return the limit of jumps between two means of the residual by chance, m: (n,)."""
    n, ends = len(jump), span + MEAN_STEPS - 1
    path = _mean_path(pair)
    total_turn = running_sum(np.abs(np.diff(pair.turn)))
    distance = path[ends:][:n] - path[:n]
    scatter = np.zeros(n)
    if (distance > 0).any():
        noise = robust_sigma(jump[distance > 0])
        scatter = noise * np.maximum(1.0, distance / np.median(distance[distance > 0]))
    turn = TURN_SHARE * width * (total_turn[ends:][:n] - total_turn[:n])
    counts = (path[MEAN_STEPS - 1:] - path[:len(path) - MEAN_STEPS + 1]) / max(pair.quantum, 1e-9)
    rounding = quantum_m**2 / 6 / np.clip(counts, 1.0, MEAN_STEPS)
    # rounding is bounded: at most one count at both ends of both wheels
    rounding = np.minimum(WHOLE_DRIVE_SIGMAS**2 * (rounding[span:] + rounding[:-span]),
                          (2 * quantum_m)**2)
    return np.sqrt(WHOLE_DRIVE_SIGMAS**2 * (scatter**2 + GROUND_SIGMA**2 + turn**2)
                   + rounding)


def _measure_event(pair: WheelPair, residual: Floats, windows: list[Window], begin: int,
                   end: int) -> Event:
    """Return the event in the rows from begin to end, by the window with the clearest jump."""
    size, first, span = 0.0, 0, 0      # of this window
    for window in windows:
        low, high = max(0, begin - MEAN_STEPS), max(0, end - window.span + 1)
        rows = low + np.flatnonzero(window.is_large[low:high])
        if len(rows):
            row = int(rows[np.argmax(np.abs(window.jump[rows]))])
            # a longer window is better only if its jump is larger by more than its noise
            noise = window.limit[row] / WHOLE_DRIVE_SIGMAS if span else 0.0
            if abs(window.jump[row]) > abs(size) + noise:
                size, first, span = float(window.jump[row]), row, window.span
    # from a tenth to nine tenths of the jump
    inside = residual[first:first + span + MEAN_STEPS]
    share = (inside - inside[:MEAN_STEPS].mean()) / size if size else inside
    last_low = int(np.flatnonzero(share <= 0.1)[-1]) if (share <= 0.1).any() else 0
    high_rows = np.flatnonzero(share >= 0.9)
    high_rows = high_rows[high_rows >= MEAN_STEPS // 2]
    first_high = int(high_rows[0]) if len(high_rows) else len(inside) - 1
    return Event(float(pair.t[first + min(last_low, first_high)]),
                 float(pair.t[first + max(last_low, first_high)]), size)


def _find_wheel(pair: WheelPair, mean_path: Floats, imu: ImuRows, track: Track,
                latitude: float, event: Event) -> int:
    """Return the wheel that slipped: -1 left, +1 right, or 0 if acceleration does not show it."""
    # a slip of the right wheel by x moves the mean path of the wheels, (n,) m, by x / 2 relative
    # to the IMU, one of the left by -x moves it by -x / 2; the noise is their difference elsewhere
    begin, end, size = event
    grid = np.arange(max(track.t[0], pair.t[0]), min(track.t[-1], pair.t[-1]), slip.EXCESS_GRID)
    margin = 1.0        # s each side of a slip, in which speeds are set equal
    span = max(round((end - begin + 2 * margin) / slip.EXCESS_GRID), 4 * slip.END_STEPS)
    if len(grid) < 3 * span:
        return 0
    a = slip.acceleration(grid, imu.t, imu.f_b, track, np.array([1.0, 0.0, 0.0]), latitude)
    excess = slip.excess_path(span, a, np.interp(grid, pair.t, mean_path))
    turn = np.interp(grid, pair.t, pair.turn)[slip.END_STEPS:-slip.END_STEPS]
    straight = np.abs(turn[span:] - turn[:-span]) < slip.MAX_WINDOW_TURN
    window = int(np.searchsorted(grid, (begin + end) / 2)) - slip.END_STEPS - span // 2
    if not 0 <= window < len(excess) or not straight[window] or straight.sum() < 20:
        return 0
    sigma = robust_sigma(excess[straight]) + 1e-3
    log_odds = excess[window] * size / sigma**2
    # wrong wheel once in 150; if mean and IMU differ by less than a quarter of x / 2, the slip
    # begins or ends elsewhere
    is_clear = abs(log_odds) > 5.0 and abs(excess[window]) > abs(size) / 8
    return int(np.sign(log_odds)) if is_clear else 0
