# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two wheels and the gyro on one time grid, and a robust linear fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, medians, runs
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import GAP_INTERVALS, integral_at, robust_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.glitches import ROLLS
from odocal_ros.settings.config import SIDES
from odocal_ros.settings.levels import FAULT_SIGMAS

Imu = tuple[Floats, Floats, Floats]     # t s, w_b rad/s, f_b m/s^2
# robust sigmas beyond which a row has no weight; statistical: 95 % efficient on normal errors
TUKEY = 4.685
FAULT_GRID = 0.5          # s, judgement
STILL_SHARE = 0.02        # judgement: of the other wheel's travel: limit for not moving
OTHER_WHEEL_COUNTS = 8    # judgement: least counts of the other wheel meanwhile


@dataclass(frozen=True, eq=False)
class WheelPair:
    """Travel of both wheels and the vehicle's turn at the edges of equal cells."""

    t: NDArray[np.float64]        # (n,) s
    left: NDArray[np.float64]     # (n,) scale units
    right: NDArray[np.float64]    # (n,) scale units
    turn: NDArray[np.float64]     # (n,) rad about the vehicle's up axis, with gyro bias
    known: NDArray[np.bool_]      # (n - 1,) cells without a gap
    quantum: float                # scale units
    names: tuple[str, ...] = SIDES

    @property
    def step(self) -> float:
        """Return the length of a cell, s."""
        length: float = self.t[1] - self.t[0]
        return length

    def least_sigma(self, steps: Floats) -> float:
        """Return the least sigma of steps: rounding, and a part of their median."""
        return 0.3 * self.quantum + 1e-4 * float(np.median(np.abs(steps)))


def wheels_on_grid(axle: Sequence[Travel], imu: Imu, between: tuple[float, float], step: float,
                   uncertain_t: Sequence[float] | Floats = ()) -> WheelPair | None:
    """
    Return the wheels on a grid of ``step`` s, None with fewer than 20 common cells.

    imu : (t, w_b, f_b), (n,) s, (n, 3), (n, 3).   between : s, the marks.   uncertain_t : (d,) s.
    """
    t_imu, w_b, f_b = imu
    left, right = axle
    if min(len(left.t), len(right.t), len(t_imu)) < 2:
        return None
    begin = max(left.t[0], right.t[0], t_imu[0], between[0])
    end = min(left.t[-1], right.t[-1], t_imu[-1], between[1])
    t = begin + step * np.arange(max(0, int((end - begin) / step) + 1))
    if len(t) < 21:
        return None
    up_b = medians(f_b)          # the mean of gravity: roll and pitch of the mounting
    rate = w_b @ (up_b / max(float(np.linalg.norm(up_b)), 1e-9))
    known = np.ones(len(t) - 1, bool)
    for times in (left.t, right.t, t_imu):
        gap = np.diff(times)
        for k in np.flatnonzero(gap > max(GAP_INTERVALS * np.median(gap), 0.2)):
            known &= (t[1:] < times[k]) | (t[:-1] > times[k + 1])
    for at in uncertain_t:
        known &= (t[1:] < at - step) | (t[:-1] > at + step)
    return WheelPair(t, left.at(t), right.at(t), integral_at(t, t_imu, rate), known,
                     max(left.quantum, right.quantum),
                     tuple(one.name or side for one, side in zip(axle, SIDES, strict=True)))


def robust_fit(A: Floats, y: Floats, floor: float, prior: Sequence[float] | Floats | None = None,
               start: Sequence[float] | Floats | None = None) -> tuple[Floats, Floats, float]:
    """
    Return x of y = A x by least squares with Tukey's weights, its covariance, sigma of a value.

    A, y : (n, k), (n,) design and values.   floor : least sigma of a value.   prior : (k,) sigmas
    of the coefficients about zero, inf: free.   start : (k,) coefficients that fit many rows;
    default: least squares. The sigma is by the median of the residuals.
    """
    size = np.abs(A).max(axis=0)
    size[size == 0] = 1.0
    A = A / size
    weak = np.zeros(A.shape[1]) if prior is None else 1 / (np.asarray(prior) * size)**2
    weight, sigma = np.ones(len(y)), 0.0
    x = np.zeros(A.shape[1]) if start is None else np.asarray(start) * size
    tukey_passes = 20
    for turn in range(tukey_passes):
        if turn or start is not None:
            residual = y - A @ x
            sigma = max(robust_sigma(residual), floor)
            u = residual / (TUKEY * sigma)
            # absolute values first (Huber): without a start Tukey's weights can converge anywhere
            huber = start is None and turn < tukey_passes // 2
            weight = 1 / np.maximum(1.0, 3 * np.abs(u)) if huber else np.where(
                np.abs(u) < 1, (1 - u**2)**2, 0.0)
        H = (A * weight[:, None]).T @ A + np.diag(weak * max(sigma, floor)**2 + 1e-12 * len(y))
        x = np.linalg.solve(H, A.T @ (weight * y))
    return x / size, np.linalg.inv(H) * sigma**2 / np.outer(size, size), sigma


def broken_wheel_reasons(axle: Sequence[Travel], imu: Imu,
                         between: tuple[float, float]) -> tuple[Reason, ...]:
    """
    Return WHEEL_DEAD and WHEEL_REVERSED, once each, if one wheel fails; () if both count.

    axle : (2,) Travel of the left and the right wheel, scale units.   imu : (t, w_b, f_b)
    (n,) s, (n, 3) rad/s, (n, 3) m/s^2, with bias.   between : (2,) the marks, s.
    """
    two = wheels_on_grid(axle, imu, between, FAULT_GRID)
    if two is None:
        return ()
    steps = np.diff([two.left, two.right])          # (2, n)
    rolled = np.abs(steps).sum(axis=1)
    weak = int(np.argmin(rolled))
    if rolled.max() <= OTHER_WHEEL_COUNTS * two.quantum or rolled.max() == 0.0:
        return ()                                   # neither moves: the odometer is still
    if rolled[weak] <= STILL_SHARE * rolled.max():
        return (Reason(Code.WHEEL_DEAD, f'the {two.names[weak]} wheel does not count: its travel '
                       f'is {percent_text(rolled[weak], rolled.max())} of that of the '
                       f'{two.names[1 - weak]} wheel (limit {100 * STILL_SHARE:g} %). The mean of '
                       'both wheels is not the travel of the vehicle'),)
    left, right = axle
    if np.array_equal(left.s, right.s) and np.array_equal(left.t, right.t):
        return (Reason(Code.WHEEL_DEAD, 'both wheels have identical counts: one counter is sent '
                       'twice'),)
    stalled = [_stalled_cells(two, steps, k) for k in (0, 1)]
    any_stalled = np.any(stalled, axis=0)
    turn = np.diff(two.turn)
    keep = two.known & ~any_stalled & _rolling(steps, two.quantum).any(axis=0)
    if keep.sum() < 10:
        return _dead_reasons(two, steps, stalled)
    A = np.stack([steps[0], turn, np.full(len(turn), FAULT_GRID)], -1)
    x, covariance = _line(A[keep], steps[1][keep], two.least_sigma(steps))
    stalled = [_without_pivots(stalled[k], steps, A, x, k) for k in (0, 1)]
    return _dead_reasons(two, steps, stalled) + _reversed_reasons(
        two, steps, A @ x, x[0], covariance[0, 0], imu)


def _line(A: Floats, y: Floats, floor: float) -> tuple[Floats, Floats]:
    """Return the fit of the right wheel by left wheel, turn and time, and its covariance."""
    rolls = A[:, 0] != 0
    usual = float(np.median(y[rolls] / A[rolls, 0])) if rolls.any() else 1.0
    # share of the top speed: gyro bias times track width, 1 sigma
    bias_of_top = 0.02
    drift = bias_of_top * float(np.percentile(np.abs(y), 95)) / FAULT_GRID
    fits = [robust_fit(A, y, floor, (np.inf, np.inf, drift), start)
            for start in (None, (usual, 0.0, 0.0))]
    least = min(sigma for _, _, sigma in fits)
    # rad in a cell, noise of a vibrating consumer gyro: judgement. It allows larger residuals in
    # straights to a fit with turns than to one without
    gyro_noise = 2e-4
    losses = [np.minimum(1.0, ((y - A @ x) / (
        TUKEY * np.hypot(least, gyro_noise * x[1])))**2).sum() for x, _, _ in fits]
    return fits[int(np.argmin(losses))][:2]


def _rolling(steps: Floats, quantum: float) -> Bools:
    """Return a mask of the cells in which each wheel certainly rolls: (2, n)."""
    top = np.percentile(np.abs(steps), 95, axis=1, keepdims=True)
    return np.abs(steps) > np.maximum(ROLLS * top, 0.5 * quantum)


def _stalled_cells(two: WheelPair, steps: Floats, k: int) -> Bools:
    """Return a mask of cells in which wheel k is still for 2 s or more while the other rolls."""
    own, other = np.abs(steps[k]), np.abs(steps[1 - k])
    still: Bools = two.known & (own <= STILL_SHARE * other) & _rolling(steps, two.quantum)[1 - k]
    hang_time = 2.0    # s without a count while the other wheel rolls; shorter is slip
    for a, b in runs(still):
        if (b - a) * FAULT_GRID < hang_time or other[a:b].sum() < OTHER_WHEEL_COUNTS * two.quantum:
            still[a:b] = False
    return still


def _without_pivots(stalled: Bools, steps: Floats, A: Floats, x: Floats, k: int) -> Bools:
    """Return the cells of ``stalled`` in which the wheel is not the centre of a turn."""
    stalled = stalled.copy()
    ratio, turn_part = x[0], A[:, 1:] @ x[1:]
    for a, b in runs(stalled):
        if k == 1:
            there, alone = (A[a:b] @ x).sum(), ratio * steps[0][a:b].sum()
        else:
            there, alone = steps[1][a:b].sum() - turn_part[a:b].sum(), steps[1][a:b].sum()
        if abs(there) < abs(alone) / 2:
            stalled[a:b] = False
    return stalled


def _dead_reasons(two: WheelPair, steps: Floats, stalled: list[Bools]) -> tuple[Reason, ...]:
    """Return WHEEL_DEAD with the times, for the wheel that is still for longer."""
    k = int(stalled[1].sum() > stalled[0].sum())
    spans = runs(stalled[k])
    if not len(spans):
        return ()
    first, last = spans[0][0], spans[-1][1]
    other = np.abs(steps[1 - k])
    lost = other[stalled[k]].sum()
    after = np.abs(steps[k][last:]).sum() <= STILL_SHARE * other[last:].sum() + two.quantum
    within = np.abs(steps[k][first:]).sum() <= STILL_SHARE * other[first:].sum() + two.quantum
    begin = two.t[first]
    if within:
        where = f'from t = {begin:.1f} s on'
    else:
        where = f'{len(spans)} time{"s" * (len(spans) > 1)}, first from t = {begin:.1f} s for ' \
                f'{(spans[0][1] - first) * FAULT_GRID:.1f} s'
        where += f', last from t = {two.t[spans[-1][0]]:.1f} s on' * bool(after and len(spans) > 1)
    return (Reason(Code.WHEEL_DEAD, f'the {two.names[k]} wheel does not count {where}, in '
                   f'{percent_text(lost, other.sum())} of the travel of the {two.names[1 - k]} '
                   'wheel: the mean of both wheels is not the travel of the vehicle'),)


def percent_text(part: float, whole: float) -> str:
    """Return a share of a travel as text."""
    return f'{100 * part / whole:.2g} %'


def _reversed_reasons(two: WheelPair, steps: Floats, expected: Floats, ratio: float,
                      variance: float, imu: Imu) -> tuple[Reason, ...]:
    """Return WHEEL_REVERSED if the right wheel contradicts left wheel and gyro."""
    if ratio < -FAULT_SIGMAS * np.sqrt(variance) and ratio < -0.1:
        k = _wheel_against_imu(two, steps, imu)
        which = (f'the {two.names[k]} wheel counts down when the vehicle drives forward, the '
                 f'{two.names[1 - k]} wheel counts up' if k is not None else
                 'one wheel counts up while the other counts down; the IMU data cannot decide '
                 'which is correct')
        return (Reason(Code.WHEEL_REVERSED, f'{which}: the mean of both wheels is not the travel '
                       'of the vehicle'),)
    rolling = _rolling(np.stack([expected, steps[1]]), two.quantum).all(axis=0)
    against = two.known & rolling & (expected * steps[1] < 0) & (steps[0] * steps[1] < 0)
    against_time = 1.5    # s of counting against the other wheel
    spans = [(a, b) for a, b in runs(against) if (b - a) * FAULT_GRID >= against_time]
    if ratio <= 0 or not spans:
        return ()
    back = [-step[step < 0].sum() for step in steps]
    unsigned = [k for k in (0, 1) if back[k] <= 3 * two.quantum + STILL_SHARE * back[1 - k]]
    which = (f'the {two.names[unsigned[0]]} wheel also counts up in reverse' if len(unsigned) == 1
             else 'one wheel counts up while the other counts down')
    a, b = spans[0]
    return (Reason(Code.WHEEL_REVERSED, f'{which}: {len(spans)} time{"s" * (len(spans) > 1)}, '
                   f'first at t = {two.t[a]:.1f} s for {(b - a) * FAULT_GRID:.1f} s'),)


def _wheel_against_imu(two: WheelPair, steps: Floats, imu: Imu) -> int | None:
    """Return the wheel that accelerates opposite to the IMU's x axis, None if uncertain."""
    t_imu, _, f_b = imu
    push = np.diff(integral_at((two.t[:-1] + two.t[1:]) / 2, t_imu, f_b[:, 0]))
    push = push - np.median(push)
    score = [_correlation(np.diff(step), push) for step in steps]
    if score[0] * score[1] < 0 and min(np.abs(score)) > FAULT_SIGMAS:
        return int(np.argmin(score))
    return None


def _correlation(a: Floats, b: Floats) -> float:
    """Return the correlation of two series about zero, in sigmas of uncorrelated ones."""
    power = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / power * np.sqrt(len(a)) if power else 0.0
