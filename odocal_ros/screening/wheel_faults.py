# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of a wheel of an axle that does not count, or that counts in the wrong direction.

In equal cells of time, travel of the right wheel = ratio * travel of the left wheel + track width
* turn of the vehicle + constant by the gyro bias. A robust fit gives the ratio, which is near 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, medians, runs
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import GAP_INTERVALS, integral_at
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.glitches import ROLLING_SHARE
from odocal_ros.screening.inputs import ImuRows
from odocal_ros.screening.robust_fit import robust_fit, TUKEY
from odocal_ros.settings.config import SIDES
from odocal_ros.settings.levels import FAULT_SIGMAS

FAULT_CELL = 0.5          # s, judgement: duration of a cell
STALLED_SHARE = 0.02      # judgement: share of the other wheel's travel; a stalled wheel has less
OTHER_WHEEL_COUNTS = 8    # judgement: least counts of the other wheel during a stall
SENT_TWICE_REMEDY = ('Check odometer.left and odometer.right, and in the driver that each wheel '
                     'has its own counter.')


@dataclass(frozen=True, eq=False)
class WheelPair:
    """Travel of both wheels and the vehicle's turn at the edges of equal cells."""

    t: NDArray[np.float64]        # (n,) s
    left: NDArray[np.float64]     # (n,) scale units
    right: NDArray[np.float64]    # (n,) scale units
    turn: NDArray[np.float64]     # (n,) rad about the vehicle's up axis, with gyro bias
    is_complete: NDArray[np.bool_]    # (n - 1,) False: a gap is in the cell
    quantum: float                # scale units, step of the counters
    names: tuple[str, ...] = SIDES

    @property
    def cell_s(self) -> float:
        """Return the duration of a cell, s."""
        return float(self.t[1] - self.t[0])

    def min_sigma(self, steps: Floats) -> float:
        """Return the least sigma of travel in cells: rounding, and a part of their median."""
        return 0.3 * self.quantum + 1e-4 * float(np.median(np.abs(steps)))


def wheels_on_grid(axle: Sequence[Travel], imu: ImuRows, t_stop: float, cell_s: float,
                   uncertain_t: Sequence[float] | Floats = ()) -> WheelPair | None:
    """
    Return the wheels in cells of ``cell_s`` s, None with fewer than 20 common cells.

    axle : left and right wheel.   t_stop : s, end of the cells; they begin at 0 at the earliest.
    uncertain_t : (d,) s, times of uncertain travel; cells next to them are not complete.
    """
    t_imu, w_b, f_b = imu
    left, right = axle
    if min(len(left.t), len(right.t), len(t_imu)) < 2:
        return None
    begin = max(left.t[0], right.t[0], t_imu[0], 0.0)
    end = min(left.t[-1], right.t[-1], t_imu[-1], t_stop)
    t = begin + cell_s * np.arange(max(0, int((end - begin) / cell_s) + 1))
    if len(t) < 21:
        return None
    up_b = medians(f_b)          # the mean of gravity: roll and pitch of the mounting
    rate = w_b @ (up_b / max(float(np.linalg.norm(up_b)), 1e-9))
    is_complete = np.ones(len(t) - 1, bool)
    for times in (left.t, right.t, t_imu):
        interval = np.diff(times)
        for k in np.flatnonzero(interval > max(GAP_INTERVALS * np.median(interval), 0.2)):
            is_complete &= (t[1:] < times[k]) | (t[:-1] > times[k + 1])
    for time in uncertain_t:
        is_complete &= (t[1:] < time - cell_s) | (t[:-1] > time + cell_s)
    return WheelPair(t, left.at(t), right.at(t), integral_at(t, t_imu, rate), is_complete,
                     max(left.quantum, right.quantum),
                     tuple(wheel.name or side for wheel, side in zip(axle, SIDES, strict=True)))


def broken_wheel_reasons(axle: Sequence[Travel], imu: ImuRows,
                         t_stop: float) -> tuple[Reason, ...]:
    """Return WHEEL_DEAD and WHEEL_REVERSED if the left or the right wheel fails, else ()."""
    pair = wheels_on_grid(axle, imu, t_stop, FAULT_CELL)
    if pair is None:
        return ()
    steps = np.diff([pair.left, pair.right])          # (2, n) travel in each cell
    path = np.abs(steps).sum(axis=1)
    slower = int(np.argmin(path))
    if path.max() <= OTHER_WHEEL_COUNTS * pair.quantum or path.max() == 0.0:
        return ()                                   # the vehicle does not move
    if path[slower] <= STALLED_SHARE * path.max():
        return (Reason(Code.WHEEL_DEAD, f'the {pair.names[slower]} wheel does not count: its '
                       f'travel is {percent_text(path[slower], path.max())} of that of the '
                       f'{pair.names[1 - slower]} wheel (limit {100 * STALLED_SHARE:g} %). The '
                       'mean of both wheels is not the travel of the vehicle'),)
    left, right = axle
    if np.array_equal(left.s, right.s) and np.array_equal(left.t, right.t):
        return (Reason(Code.WHEEL_DEAD, 'both wheels have identical counts: one counter is sent '
                       'twice', SENT_TWICE_REMEDY),)
    stalled = [_stalled_cells(pair, steps, k) for k in (0, 1)]
    any_stalled = np.any(stalled, axis=0)
    turn = np.diff(pair.turn)
    use = pair.is_complete & ~any_stalled & _rolling(steps, pair.quantum).any(axis=0)
    min_cells = 10    # of a fit of three coefficients
    if use.sum() < min_cells:
        return _dead_reasons(pair, steps, stalled)
    design = np.stack([steps[0], turn, np.full(len(turn), FAULT_CELL)], -1)
    x, covariance = _fit_right_wheel(design[use], steps[1][use], pair.min_sigma(steps))
    stalled = [_without_pivots(stalled[k], steps, design, x, k) for k in (0, 1)]
    return _dead_reasons(pair, steps, stalled) + _reversed_reasons(
        pair, steps, design @ x, x[0], covariance[0, 0], imu)


def _fit_right_wheel(design: Floats, y: Floats, min_sigma: float) -> tuple[Floats, Floats]:
    """
    Return the three coefficients of the module docstring, and their covariance.

    design : (n, 3) travel of the left wheel, turn, rad, duration, s, of each cell.   y : (n,)
    travel of the right wheel.   min_sigma : least sigma of y. There are two robust fits,
    one of which starts without turns; the one with fewer outliers is used.
    """
    rolling = design[:, 0] != 0
    usual_ratio = float(np.median(y[rolling] / design[rolling, 0])) if rolling.any() else 1.0
    # 1 sigma of gyro bias times track width, over the top speed
    drift_share = 0.02
    drift = drift_share * float(np.percentile(np.abs(y), 95)) / FAULT_CELL
    fits = [robust_fit(design, y, min_sigma, (np.inf, np.inf, drift), start)
            for start in (None, (usual_ratio, 0.0, 0.0))]
    smallest_sigma = min(fit.sigma for fit in fits)
    # rad in a cell, noise of a vibrating consumer gyro: judgement. It allows larger residuals in
    # straights to a fit with turns than to one without
    gyro_noise = 2e-4
    losses = [np.minimum(1.0, ((y - design @ x) / (      # squared residuals, 1 for an outlier
        TUKEY * np.hypot(smallest_sigma, gyro_noise * x[1])))**2).sum() for x, _, _ in fits]
    return fits[int(np.argmin(losses))][:2]


def _rolling(steps: Floats, quantum: float) -> Bools:
    """Return a mask of the cells in which a wheel certainly rolls, of (2, n) steps: (2, n)."""
    top = np.percentile(np.abs(steps), 95, axis=1, keepdims=True)
    return np.abs(steps) > np.maximum(ROLLING_SHARE * top, 0.5 * quantum)


def _stalled_cells(pair: WheelPair, steps: Floats, k: int) -> Bools:
    """Return a mask of cells in which wheel k is still for 2 s or more while the other rolls."""
    this_wheel, other = np.abs(steps[k]), np.abs(steps[1 - k])
    other_rolls = _rolling(steps, pair.quantum)[1 - k]
    still: Bools = pair.is_complete & (this_wheel <= STALLED_SHARE * other) & other_rolls
    shortest_stall = 2.0    # s without a count while the other wheel rolls; shorter is slip
    for begin, end in runs(still):
        if ((end - begin) * FAULT_CELL < shortest_stall
                or other[begin:end].sum() < OTHER_WHEEL_COUNTS * pair.quantum):
            still[begin:end] = False
    return still


def _without_pivots(stalled: Bools, steps: Floats, design: Floats, x: Floats, k: int) -> Bools:
    """Return the cells of ``stalled`` in which wheel k is not the centre of a turn, by the fit."""
    stalled = stalled.copy()
    ratio, turn_part = x[0], design[:, 1:] @ x[1:]
    for begin, end in runs(stalled):
        cells = slice(begin, end)
        # travel of wheel k that the other wheel and the gyro predict, and without the turn
        if k == 1:
            predicted, straight = (design[cells] @ x).sum(), ratio * steps[0][cells].sum()
        else:
            straight = steps[1][cells].sum()
            predicted = straight - turn_part[cells].sum()
        if abs(predicted) < abs(straight) / 2:
            stalled[cells] = False
    return stalled


def _dead_reasons(pair: WheelPair, steps: Floats, stalled: list[Bools]) -> tuple[Reason, ...]:
    """Return WHEEL_DEAD with the times, for the wheel that is still for longer."""
    k = int(stalled[1].sum() > stalled[0].sum())
    spans = runs(stalled[k])
    if not len(spans):
        return ()
    first, last = spans[0][0], spans[-1][1]
    other = np.abs(steps[1 - k])

    def is_dead_from(cell: int) -> bool:
        other_travel: float = other[cell:].sum()
        return bool(np.abs(steps[k][cell:]).sum() <= STALLED_SHARE * other_travel + pair.quantum)
    begin = pair.t[first]
    if is_dead_from(first):
        when = f'from t = {begin:.1f} s on'
    else:
        several = len(spans) > 1
        when = f'in {len(spans)} interval{"s" * several}, first from t = {begin:.1f} s for ' \
               f'{(spans[0][1] - first) * FAULT_CELL:.1f} s'
        if several and is_dead_from(last):
            when += f', last from t = {pair.t[spans[-1][0]]:.1f} s on'
    return (Reason(Code.WHEEL_DEAD, f'the {pair.names[k]} wheel does not count {when}, in '
                   f'{percent_text(other[stalled[k]].sum(), other.sum())} of the travel of the '
                   f'{pair.names[1 - k]} wheel: the mean of both wheels is not the travel of the '
                   'vehicle'),)


def percent_text(part: float, total: float) -> str:
    """Return a part of a total as text in per cent."""
    return f'{100 * part / total:.2g} %'


def _reversed_reasons(pair: WheelPair, steps: Floats, expected: Floats, ratio: float,
                      variance: float, imu: ImuRows) -> tuple[Reason, ...]:
    """
    Return WHEEL_REVERSED if the right wheel contradicts left wheel and gyro.

    expected : (n,) travel of the right wheel by the fit.   ratio, variance : coefficient of the
    left wheel.
    """
    highest_ratio = -0.1    # of a reversed wheel: far from 0, whatever the sigma
    if ratio < min(-FAULT_SIGMAS * np.sqrt(variance), highest_ratio):
        k = _wheel_against_imu(pair, steps, imu)
        text = (f'the {pair.names[k]} wheel counts down when the vehicle drives forward, the '
                f'{pair.names[1 - k]} wheel counts up' if k is not None else
                'one wheel counts up while the other counts down; the IMU data cannot decide '
                'which is correct')
        return (Reason(Code.WHEEL_REVERSED, f'{text}: the mean of both wheels is not the travel '
                       'of the vehicle'),)
    rolling = _rolling(np.stack([expected, steps[1]]), pair.quantum).all(axis=0)
    is_opposite = (pair.is_complete & rolling
                   & (expected * steps[1] < 0) & (steps[0] * steps[1] < 0))
    min_duration = 1.5    # s of counting opposite to the other wheel
    spans = [(begin, end) for begin, end in runs(is_opposite)
             if (end - begin) * FAULT_CELL >= min_duration]
    if ratio <= 0 or not spans:
        return ()
    backward = [-step[step < 0].sum() for step in steps]
    unsigned = [k for k in (0, 1)
                if backward[k] <= 3 * pair.quantum + STALLED_SHARE * backward[1 - k]]
    text = (f'the {pair.names[unsigned[0]]} wheel also counts up in reverse' if len(unsigned) == 1
            else 'one wheel counts up while the other counts down')
    begin, end = spans[0]
    return (Reason(Code.WHEEL_REVERSED, f'{text}: {len(spans)} time{"s" * (len(spans) > 1)}, '
                   f'first at t = {pair.t[begin]:.1f} s for {(end - begin) * FAULT_CELL:.1f} s'),)


def _wheel_against_imu(pair: WheelPair, steps: Floats, imu: ImuRows) -> int | None:
    """Return the wheel that accelerates opposite to the IMU's x axis, None if uncertain."""
    acceleration = np.diff(integral_at((pair.t[:-1] + pair.t[1:]) / 2, imu.t, imu.f_b[:, 0]))
    acceleration = acceleration - np.median(acceleration)
    score = [_correlation(np.diff(step), acceleration) for step in steps]
    if score[0] * score[1] < 0 and min(np.abs(score)) > FAULT_SIGMAS:
        return int(np.argmin(score))
    return None


def _correlation(a: Floats, b: Floats) -> float:
    """Return the correlation of two series without mean, in sigmas of uncorrelated ones."""
    power = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / power * np.sqrt(len(a)) if power else 0.0
