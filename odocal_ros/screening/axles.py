# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The axles of a vehicle: which ones are used, and which ones steer."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.odometer import mean_travel, Travel
from odocal_ros.nav.time_series import running_integral
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.wheel_faults import (
    broken_wheel_reasons,
    Imu,
    percent_text,
    robust_fit,
    STILL_SHARE,
    wheels_on_grid,
)
from odocal_ros.screening.wheel_travel import Wheels
from odocal_ros.settings.levels import FAULT_SIGMAS

T = TypeVar('T')
Axle = tuple[Travel, ...]
STEER_GRID = 0.1          # s, judgement: steps in which turn rates are squared
CELL = 10                 # judgement: steps of a compared cell, 1 s
SMOOTH = np.full(11, 1 / 11)      # judgement: of the speed, 1.1 s; its counts are coarse
SLOW = 0.05               # judgement: of the top speed, below which a turn rate is noise
# judgement: share of the path by which a steered axle rolls farther; less has no effect on scale
LEAST_STEERED = 2e-5


def pair_wheels(wheels: Sequence[T]) -> list[tuple[T, ...]]:
    """Return wheels in pairs, left and right; an odd last one is alone."""
    return [tuple(wheels[k:k + 2]) for k in range(0, len(wheels), 2)]


def usable_axles(wheels: Wheels, imu: Imu,
                 between: tuple[float, float]) -> tuple[Wheels, list[Reason]]:
    """
    Return the usable wheels, with the distance of steered ones ahead, and reasons.

    imu : (t, w_b, f_b), (n,) s, (n, 3) rad/s, (n, 3) m/s^2.   between : s, the marks.

    A broken axle is left out if another one is usable and does not steer: with one wheel its mean
    is not that of the axle's middle.
    """
    axles = pair_wheels(wheels.wheels)
    faults = [_faults(axle, axles, imu, between) for axle in axles]
    reasons = [reason for why in faults for reason in why]
    if len(axles) < 2:
        return wheels, reasons
    # the working wheel of a broken axle is used to detect steering of the others
    usable = [axle if not why else _working_wheel(axle, why) for axle, why in zip(
        axles, faults, strict=True)]
    ahead = iter(_distances_ahead([axle for axle in usable if axle], imu, between,
                                  wheels.uncertain_t))
    distances = [next(ahead) if axle else np.inf for axle in usable]
    working = [replace(wheel, ahead=x)
               for axle, why, x in zip(axles, faults, distances, strict=True)
               if not why for wheel in axle]
    turning, fixed = ([wheel for wheel in working if bool(wheel.ahead) is steers]
                      for steers in (True, False))
    if reasons and (not fixed or sum(map(bool, usable)) < 2):
        return wheels, reasons
    found = [Reason(Code.WHEEL_LEFT_OUT, f'{reason.text}; {_listed(axle)} left out of the mean')
             for axle, why in zip(axles, faults, strict=True) for reason in why]
    if turning:
        found.append(Reason(Code.WHEELS_STEERED, f'{_listed(turning)} steered: a '
                            'steered wheel travels farther in turns. The scale factor is that of '
                            f'the mean of {_names(fixed)}'))
    return wheels.only(working), found


def _working_wheel(axle: Axle, why: Sequence[Reason]) -> Axle:
    """Return the working wheel of a broken axle, () if it is not certain."""
    rolled = [_path_length(wheel) for wheel in axle]
    alone = len(axle) > 1 and {reason.code for reason in why} == {Code.WHEEL_DEAD}
    return (axle[int(np.argmax(rolled))],) if alone and max(rolled) > 0 else ()


def _path_length(wheel: Travel) -> float:
    return float(np.abs(np.diff(wheel.s)).sum())


def _faults(axle: Axle, axles: list[Axle], imu: Imu,
            between: tuple[float, float]) -> tuple[Reason, ...]:
    """Return the faults of an axle; a single wheel is compared with the first axle."""
    most = max(_path_length(wheel) for other in axles for wheel in other)
    own = max(map(_path_length, axle))
    if own <= STILL_SHARE * most:
        return (Reason(Code.WHEEL_DEAD, f'{_names(axle)} did not count: the travel is '
                       f'{percent_text(own, most)} of that of the wheel that travels most (limit '
                       f'{100 * STILL_SHARE:g} %)'),) if most else ()
    if len(axle) == 1:
        axle = (*axle, replace(mean_travel(axles[0]), name='mean'))
    return broken_wheel_reasons(axle, imu, between)


def _distances_ahead(axles: list[Axle], imu: Imu, between: tuple[float, float],
                     uncertain_t: Floats) -> list[float]:
    """Return the distance of each axle ahead of the one that steers least, scale units."""
    first = mean_travel(axles[0])
    found = [(0.0, 0.0), *(_squared_distance(mean_travel(axle), first, imu, between, uncertain_t)
                           for axle in axles[1:])]
    squares, sigmas = np.transpose(found)
    least = int(np.argmin(squares))
    more, sigma = squares - squares[least], np.hypot(sigmas, sigmas[least])
    ahead: list[float] = np.where(more > FAULT_SIGMAS * sigma, np.sqrt(more), 0.0).tolist()
    return ahead


def _squared_distance(own: Travel, other: Travel, imu: Imu, between: tuple[float, float],
                      uncertain_t: Floats) -> tuple[float, float]:
    """Return the squared distance of an axle ahead of another, and its sigma; 0 if negligible."""
    two = wheels_on_grid((own, other), imu, between, STEER_GRID, uncertain_t)
    if two is None:
        return 0.0, 0.0
    at = np.arange(0, len(two.t), CELL)
    steer = steering_path(two.t, two.turn, two.right)
    A, y = np.diff(np.stack([two.right, steer, two.turn], -1)[at], axis=0), np.diff(two.left[at])
    keep = np.logical_and.reduceat(two.known, at[:-1])[:len(y)] & (np.abs(y) > 2 * two.quantum)
    if keep.sum() < CELL or not A[keep, 1].any():
        return 0.0, 0.0
    x, covariance, _ = robust_fit(A[keep], y[keep], two.least_sigma(y[keep]))
    beyond = abs(x[1]) * np.abs(A[keep, 1]).sum() > LEAST_STEERED * np.abs(y[keep]).sum()
    return (float(x[1]), float(np.sqrt(covariance[1, 1]))) if beyond else (0.0, 0.0)


def steering_path(t: Floats, turn: Floats, s: Floats, ahead: float = 0.0,
                  left: float = 0.0) -> Floats:
    """
    Return the additional path of a steered wheel over its squared distance ahead: (n,).

    t : (n,) equal steps, s.   turn, s : (n,) turn of the vehicle, rad, and travel of its unsteered
    axle.   ahead, left : position of the wheel from the middle of that axle, in the unit of s.
    """
    rate, speed = np.gradient(turn, t), np.gradient(s, t)
    speed = np.convolve(np.pad(speed, len(SMOOTH) // 2, mode='edge'), SMOOTH, mode='valid')
    along = speed - left * rate
    more = np.sign(along) * rate**2 / (np.hypot(along, ahead * rate) + np.abs(along) + 1e-12)
    more[np.abs(speed) < SLOW * np.abs(speed).max()] = 0.0
    return running_integral(t, more)


def _listed(wheels: Sequence[Travel]) -> str:
    return f'{_names(wheels)} {"is" if len(wheels) == 1 else "are"}'


def _names(wheels: Sequence[Travel]) -> str:
    return ' and '.join(one.name for one in wheels)
