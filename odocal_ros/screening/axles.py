# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The axles of a vehicle: which ones are used, and which ones steer."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.odometer import mean_travel, Travel
from odocal_ros.nav.time_series import running_integral, running_mean
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import ImuRows
from odocal_ros.screening.robust_fit import robust_fit
from odocal_ros.screening.wheel_faults import (
    broken_wheel_reasons,
    percent_text,
    STALLED_SHARE,
    wheels_on_grid,
)
from odocal_ros.screening.wheel_travel import LegWheels
from odocal_ros.settings.levels import FAULT_SIGMAS

Wheel = TypeVar('Wheel')
Axle = tuple[Travel, ...]
STEER_GRID = 0.1                # s, judgement: steps in which turn rates are squared
CELL_STEPS = 10                 # judgement: steps of a cell of the fit, 1 s
SMOOTHED_STEPS = 5              # judgement: to each side, in the running mean of the speed, 1.1 s
SLOW_SPEED_SHARE = 0.05         # judgement: of the top speed, below which a turn rate is noise
# judgement: share of the path by which a steered axle rolls farther; less has no effect on scale
MIN_STEERED_SHARE = 2e-5


def pair_wheels(wheels: Sequence[Wheel]) -> list[tuple[Wheel, ...]]:
    """Return wheels in pairs, left and right; an odd last one is alone."""
    return [tuple(wheels[k:k + 2]) for k in range(0, len(wheels), 2)]


def usable_axles(wheels: LegWheels, imu: ImuRows,
                 t_stop: float) -> tuple[LegWheels, list[Reason]]:
    """
    Return the usable wheels, with ``distance_ahead`` of steered ones, and reasons.

    A broken axle is left out if another one is usable and does not steer: one wheel does not
    measure the travel of the axle's middle.
    """
    axles = pair_wheels(wheels.wheels)
    faults = [_axle_faults(axle, axles, imu, t_stop) for axle in axles]
    all_faults = list(chain(*faults))
    if len(axles) < 2:
        return wheels, all_faults
    # the working wheel of a broken axle is used to detect steering of the others
    tested = [_working_wheel(axle, axle_faults) if axle_faults else axle
              for axle, axle_faults in zip(axles, faults, strict=True)]
    distances = _distances_ahead(tested, imu, t_stop, wheels.uncertain_mean.t)
    working = [replace(wheel, distance_ahead=distance)
               for axle, axle_faults, distance in zip(axles, faults, distances, strict=True)
               if not axle_faults for wheel in axle]
    steered = [wheel for wheel in working if wheel.distance_ahead]
    unsteered = [wheel for wheel in working if not wheel.distance_ahead]
    if all_faults and (not unsteered or sum(map(bool, tested)) < 2):
        return wheels, all_faults
    reasons = [Reason(Code.WHEEL_LEFT_OUT, f'{fault.text}; {_subject(axle)} left out of the mean')
               for axle, axle_faults in zip(axles, faults, strict=True) for fault in axle_faults]
    if steered:
        reasons.append(Reason(Code.WHEELS_STEERED, f'{_subject(steered)} steered: a '
                              'steered wheel travels farther in turns. The scale factor is that '
                              f'of the mean of {_names(unsteered)}'))
    return replace(wheels, wheels=tuple(working)), reasons


def _working_wheel(axle: Axle, faults: Sequence[Reason]) -> Axle:
    """Return the working wheel of a broken axle, () if it is not certain."""
    paths = [_path_length(wheel) for wheel in axle]
    one_dead = len(axle) > 1 and {fault.code for fault in faults} == {Code.WHEEL_DEAD}
    return (axle[int(np.argmax(paths))],) if one_dead and max(paths) > 0 else ()


def _path_length(wheel: Travel) -> float:
    return float(np.abs(np.diff(wheel.s)).sum())


def _axle_faults(axle: Axle, axles: list[Axle], imu: ImuRows,
                 t_stop: float) -> tuple[Reason, ...]:
    """Return the faults of an axle; a single wheel is compared with the first axle."""
    longest = max(_path_length(wheel) for other in axles for wheel in other)
    path = max(map(_path_length, axle))
    if path <= STALLED_SHARE * longest:
        return (Reason(Code.WHEEL_DEAD, f'{_names(axle)} did not count: the travel is '
                       f'{percent_text(path, longest)} of that of the wheel that travels most '
                       f'(limit {100 * STALLED_SHARE:g} %)'),) if longest else ()
    if len(axle) == 1:
        axle = (*axle, replace(mean_travel(axles[0]), name='mean'))
    return broken_wheel_reasons(axle, imu, t_stop)


def _distances_ahead(axles: list[Axle], imu: ImuRows, t_stop: float,
                     uncertain_t: Floats) -> list[float]:
    """Return distances ahead of the axle that steers least, scale units; inf without wheels."""
    tested = [k for k, axle in enumerate(axles) if axle]
    distances = np.full(len(axles), np.inf)
    if tested:
        first, *others = (mean_travel(axles[k]) for k in tested)
        squares, sigmas = np.transpose([(0.0, 0.0), *(
            _squared_distance(other, first, imu, t_stop, uncertain_t) for other in others)])
        reference = int(np.argmin(squares))
        square, sigma = squares - squares[reference], np.hypot(sigmas, sigmas[reference])
        distances[tested] = np.where(square > FAULT_SIGMAS * sigma, np.sqrt(square), 0.0)
    return distances.tolist()


def _squared_distance(axle: Travel, other: Travel, imu: ImuRows, t_stop: float,
                      uncertain_t: Floats) -> tuple[float, float]:
    """Return the squared distance of an axle ahead of another, and its sigma; 0 if negligible."""
    # its travel is that of the other axle, the additional path of a steered axle times the squared
    # distance, and the turn
    pair = wheels_on_grid((axle, other), imu, t_stop, STEER_GRID, uncertain_t)    # left: axle
    if pair is None:
        return 0.0, 0.0
    edges = np.arange(0, len(pair.t), CELL_STEPS)
    steering = steering_path(pair.t, pair.turn, pair.right)
    design = np.diff(np.stack([pair.right, steering, pair.turn], -1)[edges], axis=0)
    y = np.diff(pair.left[edges])
    use = np.logical_and.reduceat(pair.is_complete, edges[:-1])[:len(y)] & (     # for each cell
        np.abs(y) > 2 * pair.quantum)
    if use.sum() < CELL_STEPS or not design[use, 1].any():
        return 0.0, 0.0
    x, covariance, _ = robust_fit(design[use], y[use], pair.min_sigma(y[use]))
    additional_path = abs(x[1]) * np.abs(design[use, 1]).sum()
    if additional_path <= MIN_STEERED_SHARE * np.abs(y[use]).sum():
        return 0.0, 0.0
    return float(x[1]), float(np.sqrt(covariance[1, 1]))


def steering_path(t: Floats, turn: Floats, s: Floats, ahead: float = 0.0,
                  left: float = 0.0) -> Floats:
    """
    Return the additional path of a steered wheel over its squared distance ahead: (n,).

    t : (n,) equal steps, s.   turn, s : (n,) turn of the vehicle, rad, and travel of its unsteered
    axle.   ahead, left : position of the wheel from the middle of that axle, in the unit of s.

    With u the speed at the wheel along the vehicle and r the turn rate, the additional speed is
    sqrt(u^2 + (ahead r)^2) - |u| = (ahead r)^2 / (sqrt(u^2 + (ahead r)^2) + |u|).
    """
    rate, speed = np.gradient(turn, t), running_mean(np.gradient(s, t), SMOOTHED_STEPS)
    u = speed - left * rate
    additional = np.sign(u) * rate**2 / (np.hypot(u, ahead * rate) + np.abs(u) + 1e-12)
    additional[np.abs(speed) < SLOW_SPEED_SHARE * np.abs(speed).max()] = 0.0
    return running_integral(t, additional)


def _subject(wheels: Sequence[Travel]) -> str:
    return f'{_names(wheels)} {"is" if len(wheels) == 1 else "are"}'


def _names(wheels: Sequence[Travel]) -> str:
    return ' and '.join(wheel.name for wheel in wheels)
