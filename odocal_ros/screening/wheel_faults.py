# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Faults of wheels: one does not count, or counts in the opposite direction.

They are detected from the wheels and the gyro, before attitude or scale is known. With such a
fault the mean of both wheels is not the travel.
"""

from collections.abc import Sequence

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.data.pieces import runs
from odocal_ros.nav.integral import integral_at
from odocal_ros.nav.odometer import Travel
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.glitches import ROLLS
from odocal_ros.screening.wheel_pair import Imu, Pair, pair, robust_fit, TUKEY
from odocal_ros.settings.levels import FAULT_SIGMAS

FAULT_GRID = 0.5          # s, judgement
STILL_SHARE = 0.02        # judgement: of the other wheel's travel: limit for not moving
OTHER_WHEEL_COUNTS = 8    # judgement: least counts of the other wheel meanwhile


def broken_wheels(axle: Sequence[Travel], imu: Imu,
                  between: tuple[float, float]) -> tuple[Reason, ...]:
    """
    Return WHEEL_DEAD and WHEEL_REVERSED, once each, if one wheel fails; () if both count.

    axle : (2,) Travel of the left and the right wheel, scale units.   imu : (t, w_b, f_b)
    (n,) s, (n, 3) rad/s, (n, 3) m/s^2, with bias.   between : (2,) the marks, s.
    """
    two = pair(axle, imu, between, FAULT_GRID)
    if two is None:
        return ()
    steps = np.diff([two.left, two.right])          # (2, n)
    rolled = np.abs(steps).sum(axis=1)
    weak = int(np.argmin(rolled))
    if rolled.max() <= OTHER_WHEEL_COUNTS * two.quantum or rolled.max() == 0.0:
        return ()                                   # neither moves: the odometer is still
    if rolled[weak] <= STILL_SHARE * rolled.max():
        return (Reason(Code.WHEEL_DEAD, f'the {two.names[weak]} wheel does not count: its travel '
                       f'is {in_per_cent(rolled[weak], rolled.max())} of that of the '
                       f'{two.names[1 - weak]} wheel (limit {100 * STILL_SHARE:g} %). The mean of '
                       'both is not the travel'),)
    left, right = axle
    if np.array_equal(left.s, right.s) and np.array_equal(left.t, right.t):
        return (Reason(Code.WHEEL_DEAD, 'both wheels have identical counts: one counter is sent '
                       'twice'),)
    held = [_held(two, steps, k) for k in (0, 1)]
    hung = np.any(held, axis=0)
    turn = np.diff(two.turn)
    keep = two.known & ~hung & _rolling(steps, two.quantum).any(axis=0)
    if keep.sum() < 10:
        return _dead(two, steps, held)
    A = np.stack([steps[0], turn, np.full(len(turn), FAULT_GRID)], -1)
    x, covariance = _line(A[keep], steps[1][keep], two.least_sigma(steps))
    held = [_not_pivoting(held[k], steps, A, x, k) for k in (0, 1)]
    return _dead(two, steps, held) + _reversed(two, steps, A @ x, x[0], covariance[0, 0], imu)


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
    left_over = [np.minimum(1.0, ((y - A @ x) / (
        TUKEY * np.hypot(least, gyro_noise * x[1])))**2).sum() for x, _, _ in fits]
    return fits[int(np.argmin(left_over))][:2]


def _rolling(steps: Floats, quantum: float) -> Bools:
    """Return a mask of the cells in which each wheel certainly rolls: (2, n)."""
    top = np.percentile(np.abs(steps), 95, axis=1, keepdims=True)
    return np.abs(steps) > np.maximum(ROLLS * top, 0.5 * quantum)


def _held(two: Pair, steps: Floats, k: int) -> Bools:
    """Return a mask of cells in which wheel k is still for 2 s or more while the other rolls."""
    own, other = np.abs(steps[k]), np.abs(steps[1 - k])
    still: Bools = two.known & (own <= STILL_SHARE * other) & _rolling(steps, two.quantum)[1 - k]
    hang_time = 2.0    # s without a count while the other wheel rolls; shorter is slip
    for a, b in runs(still):
        if (b - a) * FAULT_GRID < hang_time or other[a:b].sum() < OTHER_WHEEL_COUNTS * two.quantum:
            still[a:b] = False
    return still


def _not_pivoting(held: Bools, steps: Floats, A: Floats, x: Floats, k: int) -> Bools:
    """Return the cells of ``held`` in which the wheel is not the centre of a turn."""
    held = held.copy()
    ratio, turn_part = x[0], A[:, 1:] @ x[1:]
    for a, b in runs(held):
        if k == 1:
            there, alone = (A[a:b] @ x).sum(), ratio * steps[0][a:b].sum()
        else:
            there, alone = steps[1][a:b].sum() - turn_part[a:b].sum(), steps[1][a:b].sum()
        if abs(there) < abs(alone) / 2:
            held[a:b] = False
    return held


def _dead(two: Pair, steps: Floats, held: list[Bools]) -> tuple[Reason, ...]:
    """Return WHEEL_DEAD with the times, for the wheel that is still for longer."""
    k = int(held[1].sum() > held[0].sum())
    spans = runs(held[k])
    if not len(spans):
        return ()
    first, last = spans[0][0], spans[-1][1]
    other = np.abs(steps[1 - k])
    lost = other[held[k]].sum()
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
                   f'{in_per_cent(lost, other.sum())} of the travel of the {two.names[1 - k]} '
                   'wheel: the mean of both is not the travel'),)


def in_per_cent(part: float, whole: float) -> str:
    """Return a share of a travel as text."""
    return f'{100 * part / whole:.2g} %'


def _reversed(two: Pair, steps: Floats, expected: Floats, ratio: float, variance: float,
              imu: Imu) -> tuple[Reason, ...]:
    """Return WHEEL_REVERSED if the right wheel contradicts left wheel and gyro."""
    if ratio < -FAULT_SIGMAS * np.sqrt(variance) and ratio < -0.1:
        k = _against_imu(two, steps, imu)
        which = (f'the {two.names[k]} wheel counts down when the vehicle drives forward, the '
                 f'{two.names[1 - k]} wheel counts up' if k is not None else
                 'one wheel counts up while the other counts down; the IMU data cannot decide '
                 'which is correct')
        return (Reason(Code.WHEEL_REVERSED, f'{which}: the mean of both is not the travel'),)
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


def _against_imu(two: Pair, steps: Floats, imu: Imu) -> int | None:
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
