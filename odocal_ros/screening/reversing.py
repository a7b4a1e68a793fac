# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of reversing with an unsigned counter: it counts up while accelerations point backwards.

After a stop the specific force along the vehicle is proportional to the acceleration of the
wheels, with the same ratio at every start. If the ratio has the opposite sign, the vehicle
reversed. The IMU detects a few metres; fixes need a path much longer than their noise.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, runs
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import double_integral_at, integral_at
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import ImuRows
from odocal_ros.settings.levels import FAULT_SIGMAS
from odocal_ros.settings.nominal import G

REVERSING_STEP = 0.1        # s, judgement: step of the time grid
ACCELERATION_TIME = 0.6     # s, judgement: half the length of the second differences of travel
STOP_TIME = 1.0             # s, judgement: used before a start, at standstill
BY_IMU = 'the acceleration has the opposite sign of the other starts'
BY_FIT = 'IMU and fixes move backwards'


def reversed_starts(travel: Travel, imu: ImuRows, t_stop: float) -> Floats:
    """
    Return begin and end of reversing in which the counter counts up: (m, 2) s.

    travel : in any unit.   t_stop : s, stop mark. Motion before the start mark only contributes to
    the usual ratio. The result is empty if travel counts down in reverse, or if the IMU's x axis
    points across the vehicle.
    """
    no_spans = np.empty((0, 2))
    if len(travel.t) < 3 or len(imu.t) < 3:
        return no_spans
    t = np.arange(max(travel.t[0], imu.t[0]) + ACCELERATION_TIME,
                  min(travel.t[-1], imu.t[-1]) - ACCELERATION_TIME, REVERSING_STEP)
    if len(t) < 2 * (STOP_TIME + ACCELERATION_TIME) / REVERSING_STEP:
        return no_spans
    begins, ends = _sections_between_stops(t, travel)
    if len(begins) < 2:
        return no_spans
    force = _Forces(t, imu)
    before, middle, after = (
        travel.at(t + delay) for delay in (-ACCELERATION_TIME, 0.0, ACCELERATION_TIME))
    acceleration = (before - 2 * middle + after) / ACCELERATION_TIME**2
    ratio, sigma = np.array([_force_ratio(t, acceleration, force, begin, end)
                             for begin, end in zip(begins, ends, strict=True)]).T
    path = np.abs(travel.at(t[ends]) - travel.at(t[begins]))
    significant = np.abs(ratio) > FAULT_SIGMAS * sigma
    forward_sign = np.sign((path * np.sign(ratio))[significant].sum())
    is_forward = significant & (np.sign(ratio) == forward_sign)
    if not forward_sign or not is_forward.any():
        return no_spans
    usual_ratio = np.median(np.abs(ratio[is_forward]))
    lowest, highest = 0.5, 2.0    # ratio of a reversed start over the usual one
    is_reversed = significant & ~is_forward & (np.abs(ratio) > lowest * usual_ratio) & (
        np.abs(ratio) < highest * usual_ratio)
    is_reversed &= (t[ends] > 0.0) & (t[begins] < t_stop)
    # at the last step of the grid the vehicle still moves
    return np.stack([t[begins[is_reversed]] - ACCELERATION_TIME,
                     t[ends[is_reversed]] + ACCELERATION_TIME], -1)


def sections_slipped_twice(slips: Sequence[dict[str, Any]], travel: Travel,
                           metres_per_unit: float) -> Floats:
    """
    Return the sections between stops with a slip of twice their length, (m, 2) s: reversed ones.

    slips : of the smoother, each with ``t`` and ``duration``, s, and ``metres``, wheel travel
    minus vehicle travel. A wheel that spins on the spot slips by once its travel.
    """
    t = np.arange(travel.t[0] + ACCELERATION_TIME, travel.t[-1] - ACCELERATION_TIME,
                  REVERSING_STEP)
    if len(t) <= 2:
        return np.empty((0, 2))
    begins, ends = _sections_between_stops(t, travel)
    spans = np.stack([t[begins] - ACCELERATION_TIME, t[ends] + ACCELERATION_TIME], -1)
    path = np.abs(np.diff(travel.at(spans), axis=1))[:, 0] * metres_per_unit
    middle = np.array([slip['t'] + slip['duration'] / 2 for slip in slips])
    size = np.array([slip['metres'] for slip in slips])
    slip = np.array([size[(middle > begin) & (middle < end)].sum() for begin, end in spans])    # m
    min_path = 1.0    # m
    share = slip / np.maximum(2 * path, min_path)      # of twice the path
    lowest, highest = 0.8, 1.2      # of a reversed section
    return spans[(path > min_path) & (share > lowest) & (share < highest)]


def reversing_reasons(spans: Floats, travel: Travel, metres_per_unit: float | None, evidence: str,
                      signed: bool) -> tuple[Reason, ...]:
    """Return REVERSING_UNSIGNED with the reversed sections; evidence : BY_IMU or BY_FIT."""
    if not len(spans):
        return ()
    cause = 'the counter does not count down' if signed else 'odometer.signed is false'
    path = np.abs(np.diff(travel.at(spans), axis=1))[:, 0] * (metres_per_unit or 0.0)
    sections = [f'{end - begin:.0f} s from t = {begin:.1f} s'
                + (f', {length:.1f} m' if metres_per_unit else '')
                for (begin, end), length in zip(spans.tolist(), path.tolist(), strict=True)]
    max_listed = 3    # sections listed in the text
    more = f' and {len(sections) - max_listed} more' if len(sections) > max_listed else ''
    times = f'{len(sections)} time{"s" * (len(sections) > 1)}'
    return (Reason(Code.REVERSING_UNSIGNED, f'{times} {evidence} while the odometer counts up: '
                   f'the vehicle reversed and {cause}; counted as reverse: '
                   f'{"; ".join(sections[:max_listed])}{more}'),)


def _sections_between_stops(t: Floats, travel: Travel) -> tuple[Ints, Ints]:
    """Return the first and the last step of each section of motion that begins with a stop."""
    half = ACCELERATION_TIME / 2
    speed = np.abs(travel.at(t + half) - travel.at(t - half)) / ACCELERATION_TIME
    top = np.percentile(speed, 95)
    min_count_rate = 20.0    # counts/s at top speed: below it a counter shows no acceleration
    if top == 0.0 or top < min_count_rate * travel.quantum:
        return np.empty(0, int), np.empty(0, int)
    stop_share = 0.02    # of the top speed: below it is a stop
    stops = speed <= max(1.01 * travel.quantum / ACCELERATION_TIME, stop_share * top)
    moving = runs(~stops) - [0, 1]
    begins, ends = moving[moving[:, 0] > 0].T
    is_long = (ends - begins) * REVERSING_STEP > 2 * ACCELERATION_TIME
    return begins[is_long], ends[is_long]


class _Forces:
    """
    Integrals of the IMU's rows at the steps of a grid t: (m,).

    angle, speed : (m, 3) integrals of w, rad, and of f, m/s.   speed_before : (m, 3), the same
    ACCELERATION_TIME earlier.   along : (m,) mean of f_x, m/s^2, weighted as the second
    difference of travel weights the acceleration.
    """

    def __init__(self, t: Floats, imu: ImuRows) -> None:
        self.angle = integral_at(t, imu.t, imu.w_b)
        times = [t + delay for delay in (-ACCELERATION_TIME, 0.0, ACCELERATION_TIME)]
        self.speed_before, self.speed = (integral_at(x, imu.t, imu.f_b) for x in times[:2])
        before, middle, after = (double_integral_at(x, imu.t, imu.f_b[:, 0]) for x in times)
        self.along = (before - 2 * middle + after) / ACCELERATION_TIME**2


def _force_ratio(t: Floats, acceleration: Floats, force: _Forces, begin: int,
                 end: int) -> tuple[float, float]:
    """Return the ratio of force to odometer acceleration from step begin to end, and its sigma."""
    # fit by acceleration, constant and drift. Gravity that enters x as the vehicle pitches is
    # removed: up at the stop, by the integral of the force, is rotated by the gyro
    first = max(0, begin - round((STOP_TIME + ACCELERATION_TIME) / REVERSING_STEP))
    max_duration = 12.0    # s after a stop that are used: later the tilt drifts
    rows = slice(first, min(len(t), end + 1, begin + round(max_duration / REVERSING_STEP)))
    stop_end = max(begin - round(ACCELERATION_TIME / REVERSING_STEP), 0)
    up = force.speed[stop_end] - force.speed_before[first]
    up /= max(np.linalg.norm(up), 1e-9)
    turn = force.angle[rows] - force.angle[first]
    tilt = turn[:, 2] * up[1] - turn[:, 1] * up[2]
    y, times = force.along[rows] - G * tilt, t[rows]
    design = np.stack([acceleration[rows], np.ones(len(times)), times - times.mean()], -1)
    x, *_ = np.linalg.lstsq(design, y, rcond=None)
    cofactor = np.linalg.inv(design.T @ design + 1e-12 * np.eye(3))[0, 0]
    residual = float(np.sqrt(np.mean((y - design @ x)**2)))
    rows_per_sample = 2 * ACCELERATION_TIME / REVERSING_STEP    # adjacent rows share IMU samples
    return float(x[0]), residual * float(np.sqrt(rows_per_sample * cofactor)) + 1e-12
