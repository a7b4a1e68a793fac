# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Faults of two wheels, detected with the gyro: swapped, one slipping, different counters.

The paths of the two wheels differ by the track width times the turn. The remaining difference is
rounding and gyro noise, millimetres over seconds; a wheel that spins or slides alone exceeds it by
centimetres. With the acceleration of the IMU alone the limit is half a metre.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from odocal_ros.calib.slip import (
    acceleration,
    excess_path,
    make_wheel_slips,
    NO_SLIPS,
    PIN_STEPS,
    SLIP_GRID,
    SPIN_GRID,
    SPIN_TURN,
    wheel_slip_reason,
    WheelSlips,
)
from odocal_ros.calib.wheel_pair_regression import (
    counter_reasons,
    find_ratio_change,
    fit_signals,
    MEAN_STEPS,
    regressors,
    side_reasons,
    WHOLE_DRIVE_SIGMAS,
    without_gyro_drift,
)
from odocal_ros.data.arrays import Bools, Floats, running_sum, runs
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import robust_sigma
from odocal_ros.reasons import Reason
from odocal_ros.screening.wheel_faults import WheelPair, wheels_on_grid

Event = tuple[float, float, float]      # begin, end, s, and size, m
# steps between the ends of windows: slips of up to 1, 3, 8, 20, 50 s; others are detected too.
# Judgement
SLIP_SPANS = (10, 30, 80, 200, 500)
# 1 sigma of the difference of two wheels on real ground without a slip. Physical, judgement: m in
# any window (stones, tyres); share of track width times turn (scrub, camber, the gyro's scale)
TYRE_BLUR, TURN_DOUBT = 0.005, 0.01


def wheel_faults(axle: Sequence[Travel], imu: tuple[Floats, Floats, Floats],
                 between: tuple[float, float], track: Track, latitude: float,
                 metres_per_unit: float, track_width: float = 0.0,
                 uncertain_t: Floats | None = None,
                 max_deviation: float = 0.35,
                 count: int = 2) -> tuple[tuple[Reason, ...], WheelSlips]:
    """
    Return the faults of two counting wheels by the gyro, and the slips of one of them.

    axle : (2,) sequence of Travel the left and the right wheel, scale units.   imu : (t, w_b, f_b)
    (n,) s, (n, 3) rad/s, (n, 3) m/s^2, with their bias.   between : (2,) the marks, s.   track :
    dead reckoned with the mean of both, for attitudes.   latitude : rad.   metres_per_unit :
    approximate scale of the mean.   track_width : m, 0 unknown.   uncertain_t : (d,) s, times of
    travel that is uncertain for other reasons (gaps, resets).   max_deviation : limit of the ratio
    of the counts minus one.   count : number of wheels in the mean.
    """
    two = wheels_on_grid(axle, imu, between, SLIP_GRID,
                         np.empty(0) if uncertain_t is None else uncertain_t)
    if two is None or not metres_per_unit:
        return (), NO_SLIPS
    two = without_gyro_drift(two)
    signals = regressors(two, metres_per_unit)
    x, covariance = fit_signals(two, signals, metres_per_unit)
    if x is None or covariance is None or x[0] <= 0:
        return (), NO_SLIPS
    ratio = x[0]                                          # right counts over left ones
    per_right = metres_per_unit * (1 + 1 / ratio) / 2     # m per count of the right wheel
    reasons = side_reasons(two, x[1] * per_right, np.sqrt(covariance[1, 1]) * per_right,
                           track_width)
    reasons += counter_reasons(two, ratio, track_width or abs(x[1]) * per_right, max_deviation)
    quantum_m = per_right * (1 + ratio) / 2
    residual = (two.right - signals @ x) * per_right         # m, residual of turn and ratio
    width = track_width or abs(x[1]) * per_right
    events, lasting = _events(two, residual, quantum_m, width)
    found, change = find_ratio_change(_without_slips(two, events), signals, metres_per_unit, count)
    reasons += found
    # a slow event is a slip; if the ratio changes, only one that is twice as steep
    events = sorted(events + lasting)
    if change:
        steep = 2 * abs(change) * metres_per_unit
        events = [e for e in events if abs(_slope(two, e)) > steep]
    if not events:
        return reasons, replace(NO_SLIPS, change=change)
    mean = (two.left * ratio + two.right) / 2 * per_right
    wheel = [_find_wheel(two, mean, imu, track, latitude, e) for e in events]
    slips = replace(make_wheel_slips(events, wheel), change=change)
    return reasons + wheel_slip_reason(slips, two.names), slips


def _without_slope(two: WheelPair, residual: Floats, quantum_m: float) -> Floats:
    """Return the difference of the paths, m, without its slope on most of the drive."""
    # slopes by rounding at a steady speed, at most two counts over a window, are not removed
    path, n = _mean_path(two), 200     # steps of a slope, 20 s: longer than most slips
    run, climb = path[n:] - path[:-n], residual[n:] - residual[:-n]
    if len(run) < n:
        return residual
    moves = run > max(np.median(run) / 2, 2 * two.quantum)
    slope = np.median(climb[moves] / run[moves]) if moves.any() else 0.0
    slope_uncertainty = 2 * quantum_m * (two.quantum > 0) / max(np.median(run), 1e-9)
    out: Floats = residual - np.sign(slope) * max(abs(slope) - slope_uncertainty, 0.0) * path
    return out


def _without_slips(two: WheelPair, events: list[Event]) -> WheelPair:
    """Return the wheels, with the cells of slips marked as unknown."""
    known, around = two.known.copy(), 2.0       # s each side, possibly part of the slip
    for begin, end, _ in events:
        known &= (two.t[1:] < begin - around) | (two.t[:-1] > end + around)
    return replace(two, known=known)


def _events(two: WheelPair, residual: Floats, quantum_m: float,
            width: float) -> tuple[list[Event], list[Event]]:
    """Return the jumps of the difference that end, and those that may change the ratio."""
    residual = _without_slope(two, residual, quantum_m)
    total = running_sum(residual)
    mean = (total[MEAN_STEPS:] - total[:-MEAN_STEPS]) / MEAN_STEPS
    unknown = running_sum(~two.known)
    hits = np.zeros(len(two.t), bool)
    windows = []
    for span in (gap + MEAN_STEPS for gap in SLIP_SPANS):
        jump = mean[span:] - mean[:-span]
        if len(jump) < span:
            continue
        limit = _jump_limits(two, jump, span, quantum_m * (two.quantum > 0), width)
        far = np.abs(jump) > limit
        far &= unknown[span + MEAN_STEPS - 1:][:len(jump)] == unknown[:len(jump)]
        for k in np.flatnonzero(far):
            hits[k + MEAN_STEPS:k + span] = True
        windows.append((span, jump, limit, far))
    over: list[Event] = []
    lasting: list[Event] = []
    for a, b in runs(hits):
        event = _measure_jump(two, residual, windows, a, b)
        (over if _is_finished(two, residual, event) else lasting).append(event)
    return over, lasting


def _is_finished(two: WheelPair, residual: Floats, event: Event) -> bool:
    """Return True if a slip ends: it is short, or its slope is absent before and after it."""
    path = _mean_path(two)
    begin, end = np.interp(event[:2], two.t, path)
    if end - begin < path[-1] / 16:      # half a step between the places tested by `changed`
        return True
    at = np.searchsorted(two.t, event[:2]).clip(0, len(path) - 1)
    for a, b in ((0, at[0]), (at[1], len(path) - 1)):
        would, does = _slope(two, event) * (path[b] - path[a]), residual[b] - residual[a]
        if abs(would) < 0.1 or abs(does) > abs(would) / 2:      # m, observable
            return False
    return True


def _slope(two: WheelPair, event: Event) -> float:
    """Return the slope of a slip, size by path, between a tenth and nine tenths of its size."""
    begin, end = np.interp(event[:2], two.t, _mean_path(two))
    out: float = 0.8 * event[2] / max(end - begin, 1e-9)
    return out


def _mean_path(two: WheelPair) -> Floats:
    return running_sum(np.abs(np.diff(two.left + two.right)) / 2)


def _jump_limits(two: WheelPair, jump: Floats, span: int, quantum_m: float,
                 width: float) -> Floats:
    """Return the limit of jumps between two means that occur by chance, m."""
    n, ends = len(jump), span + MEAN_STEPS - 1
    path = _mean_path(two)
    turned = running_sum(np.abs(np.diff(two.turn)))
    run = path[ends:][:n] - path[:n]
    spread = np.zeros(n)
    if (run > 0).any():
        usual = robust_sigma(jump[run > 0])
        spread = usual * np.maximum(1.0, run / np.median(run[run > 0]))
    turn = TURN_DOUBT * width * (turned[ends:][:n] - turned[:n])
    counts = (path[MEAN_STEPS - 1:] - path[:len(path) - MEAN_STEPS + 1]) / max(two.quantum, 1e-9)
    rounding = quantum_m**2 / 6 / np.clip(counts, 1.0, MEAN_STEPS)
    # rounding is bounded: at most one count at both ends of both wheels
    rounding = np.minimum(WHOLE_DRIVE_SIGMAS**2 * (rounding[span:] + rounding[:-span]),
                          (2 * quantum_m)**2)
    out: Floats = np.sqrt(WHOLE_DRIVE_SIGMAS**2 * (spread**2 + TYRE_BLUR**2 + turn**2) + rounding)
    return out


def _measure_jump(two: WheelPair, residual: Floats,
                  windows: list[tuple[int, Floats, Floats, Bools]], a: int, b: int) -> Event:
    """Return (begin, end, size) of the jump within steps a to b, by its best window."""
    found = (0.0, 0.0, 0, 0)
    for span, jump, limit, far in windows:
        low, high = max(0, a - MEAN_STEPS), max(0, b - span + 1)
        at = low + np.flatnonzero(far[low:high])
        if len(at):
            k = int(at[np.argmax(np.abs(jump[at]))])
            # a longer window is better only if its jump is larger by more than its noise
            if abs(jump[k]) > abs(found[0]) + bool(found[1]) * limit[k] / WHOLE_DRIVE_SIGMAS:
                found = (float(jump[k]), float(limit[k]), k, span)
    size, _, k, span = found
    inner = residual[k:k + span + MEAN_STEPS]
    base = inner[:MEAN_STEPS].mean()
    share = (inner - base) / size if size else inner
    begin = int(np.flatnonzero(share <= 0.1)[-1]) if (share <= 0.1).any() else 0
    late = np.flatnonzero(share >= 0.9)
    late = late[late >= MEAN_STEPS // 2]
    end = int(late[0]) if len(late) else len(inner) - 1
    return float(two.t[k + min(begin, end)]), float(two.t[k + max(begin, end)]), size


def _find_wheel(two: WheelPair, mean: Floats, imu: tuple[Floats, Floats, Floats], track: Track,
                latitude: float, event: Event) -> int:
    """Return the wheel that slipped: -1 left, +1 right, or 0 if acceleration does not show it."""
    # a slip of the right wheel by x moves the mean by x / 2 relative to the IMU, one of the left
    # by -x by -x / 2; the noise of their odds is the difference of mean and IMU elsewhere
    begin, end, size = event
    grid = np.arange(max(track.t[0], two.t[0]), min(track.t[-1], two.t[-1]), SPIN_GRID)
    beside = 1.0        # s each side of a slip, in which speeds are set equal
    span = max(round((end - begin + 2 * beside) / SPIN_GRID), 4 * PIN_STEPS)
    if len(grid) < 3 * span:
        return 0
    a = acceleration(grid, imu[0], imu[2], track, np.array([1.0, 0.0, 0.0]), latitude)
    excess = excess_path(span, a, np.interp(grid, two.t, mean))
    turn = np.interp(grid, two.t, two.turn)[PIN_STEPS:-PIN_STEPS]
    straight = np.abs(turn[span:] - turn[:-span]) < SPIN_TURN
    at = int(np.searchsorted(grid, (begin + end) / 2)) - PIN_STEPS - span // 2
    if not 0 <= at < len(excess) or not straight[at] or straight.sum() < 20:
        return 0
    sigma = robust_sigma(excess[straight]) + 1e-3
    log_odds = excess[at] * size / sigma**2
    # wrong wheel once in 150; if mean and IMU differ by less than a quarter of x / 2, the slip
    # begins or ends elsewhere
    clear = abs(log_odds) > 5.0 and abs(excess[at]) > abs(size) / 8
    return int(np.sign(log_odds)) if clear else 0
