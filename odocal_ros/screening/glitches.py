# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values that are not measurements: beyond any range, isolated outliers, or at the limit of it."""

from dataclasses import replace
from functools import reduce
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import (
    Bools,
    by_row,
    by_step,
    columns,
    Floats,
    lengths,
    median,
    reduce_columns,
    runs,
)
from odocal_ros.data.samples import HeadingSamples, ImuSamples
from odocal_ros.nav.odometer import Travel
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.nominal import G

# judgement: far beyond any sensor in any unit in use (deg/s, mm/s^2): wrong units are kept
BEYOND_SENSOR = {'w_i': 1e3, 'f_i': 1e5, 'value': 1e15, 'velocity_n': 1e5, 'q_ni': 10.0}
# judgement: least number of impossible rows in a group, each within CLUMP_REACH of the one before
CLUMP_ROWS = 5
CLUMP_REACH = 50          # rows: about a page or a packed block of a recording
# judgement: least share, or least number, of impossible rows in a damaged recording: others
# near them may be false too
DAMAGED_SHARE, SEVERAL_ROWS = 0.01, 4
ROWS_BESIDE = 5          # rows without motion on each side of an isolated outlier
# judgement: of a spike: least step from row to row, rad/s and m/s^2 (potholes are kept), and in
# median steps; s, its longest duration; largest share of the step that remains after it
TURN_STEP, FORCE_STEP, USUAL_STEPS, GLITCH_TIME, BACK_SHARE = 0.8, 50.0, 20.0, 0.4, 0.5
# judgement: of an isolated outlier: least deviation, rad/s (0.003 rad in 0.1 s) and m/s^2, and in
# deviations of adjacent rows; largest difference of the rows before and after, in deviations
SINGLE_TURN, SINGLE_FORCE, SINGLE_TIMES, EQUAL_NEIGHBOURS = 0.03, 2.0, 10.0, 0.3
GLITCH_SHARE = 0.002      # largest share of glitches; with more, they are normal for the sensor
ROLLS = 0.1               # of the top speed: least mean speed of a moving vehicle
# physical: smaller than any range, larger than gravity at rest
LEAST_GYRO, LEAST_ACCELEROMETER = 1.0, 1.5 * G      # rad/s, m/s^2
# statistical: coarse steps also repeat the largest value, but less often than the next smaller one
FEWEST_AT_LIMIT, TIMES_NEXT = 5, 3.0
Oriented = TypeVar('Oriented', ImuSamples, HeadingSamples)


def is_impossible(name: str, column: NDArray[Any]) -> Bools:
    """Return a mask of rows with NaN, Inf or an impossible value: (n, ...) to (n,) bool."""
    column = np.asarray(column)
    if np.issubdtype(column.dtype, np.integer):
        return np.zeros(len(column), bool)
    largest_value = 1e300    # of unbounded columns: sums and products with it stay finite
    most = BEYOND_SENSOR.get(name, largest_value)

    def odd(x: NDArray[Any]) -> Bools:
        size = np.abs(x)
        # smaller values, except 0, are damaged: judgement. Two rotations by right angles leave
        # 1e-68 of a value in axes of exact zeros
        least_value = 1e-80
        usable = (size <= most) & ((size >= least_value) | (size == 0))
        return ~(usable if x.ndim == 1 else reduce_columns(np.logical_and, usable))
    with np.errstate(invalid='ignore'):
        return by_row(odd, column)


def without_invalid_orientations(samples: Oriented) -> Oriented:
    """Return IMU or heading rows without invalid orientations; their variance is NaN."""
    def no_attitude(wild: Bools, q_ni: Floats, variance: Floats) -> Bools:
        length = lengths(np.where(wild[:, None], 0.0, q_ni))
        unit_length = 2.0    # largest ratio of a quaternion's length to one, and of one to it
        widest_variance = 1e12    # rad^2, drivers use smaller values for unknown
        return ((length < 1 / unit_length) | (length > unit_length)
                | (np.abs(variance) > widest_variance))

    wild = is_impossible('q_ni', samples.q_ni)
    none = by_row(no_attitude, wild, samples.q_ni, samples.yaw_variance)
    if not (wild | none & ~np.isnan(samples.yaw_variance)).any():
        return samples
    return replace(samples, q_ni=np.where(none[:, None], 0.0, samples.q_ni),
                   yaw_variance=np.where(none, np.nan, samples.yaw_variance))


def near_impossible_groups(wild: Bools) -> Bools:
    """
    Return a mask of rows in or near a group of impossible rows: (n,) bool.

    In a damaged recording only some false rows are impossible values. The mask contains each
    group, and on each side twice as many rows as the largest distance of its impossible rows.
    """
    suspect = np.zeros(len(wild), bool)
    at = np.flatnonzero(wild)
    for group in np.split(at, np.flatnonzero(np.diff(at) > CLUMP_REACH) + 1):
        if len(group) >= CLUMP_ROWS:
            wide = 2 * int(np.diff(group).max())
            suspect[max(group[0] - wide, 0):group[-1] + wide + 1] = True
    return suspect


def find_spikes(t: Floats, x: Floats, least: float) -> Bools:
    """
    Return a mask of rows that jump away from their neighbours and back: (n,) bool.

    t : (n,) s, rising.   x : (n, k) values.   least : smallest step of a spike from row to row.
    All False if so many rows jump that it is normal for the sensor.
    """
    found = np.zeros(len(x), bool)
    bound = by_step(lambda x: reduce_columns(np.maximum, np.abs(np.diff(x, axis=0))), x)
    far = np.flatnonzero(bound > least)
    if not len(far):
        return found
    size = bound[far]
    clear = size > USUAL_STEPS * median(bound)
    done = -1
    most_bounds = 2000    # jumps that are tested
    for i, bound in zip(far[clear][:most_bounds], size[clear], strict=False):
        if i < done:
            continue
        within = np.searchsorted(t, t[i] + GLITCH_TIME, side='right')
        home = np.abs(x[i + 2:within] - x[i]).max(axis=1) <= BACK_SHARE * bound
        if home.any():
            done = i + 2 + int(np.argmax(home))
            found[i + 1:done] = True
    return found if found.mean() <= GLITCH_SHARE else np.zeros(len(x), bool)


def isolated_outliers(x: Floats, least: float) -> Bools:
    """
    Return a mask of isolated outliers with no motion before and after.

    x : (n, k).   least : smallest deviation of an outlier.   Returns (n,) bool, all False if
    there are so many that it is normal for the sensor.
    """
    edge = ROWS_BESIDE + 1

    def off(x: Floats) -> Bools:
        m = len(x) - 2 * edge
        far = np.abs(x[1:-1] - (x[:-2] + x[2:]) / 2)
        if not (far > least).any():
            return np.zeros(m, bool)
        # a false row changes the deviations of adjacent rows too
        beside = reduce(np.maximum, (far[ROWS_BESIDE + k:][:m]
                                     for d in range(2, edge) for k in (-d, d)))
        at = far[ROWS_BESIDE:][:m]
        difference = np.abs(x[edge + 1:][:m] - x[ROWS_BESIDE:][:m])
        is_off: Bools = ((at > np.maximum(least, SINGLE_TIMES * beside))
                         & (difference < EQUAL_NEIGHBOURS * at))
        return reduce_columns(np.logical_or, is_off)

    found = np.zeros(len(x), bool)
    if len(x) > 2 * edge:
        found[edge:-edge] = by_step(off, x, steps=2 * edge)
    found &= found.sum() <= max(GLITCH_SHARE * len(x), CLUMP_ROWS)
    return found


def imu_glitches(t: Floats, w_i: Floats, f_i: Floats, imu: ImuConfig) -> Bools:
    """Return a mask of IMU rows that are spikes or isolated outliers; imu : its scale factors."""
    gyro, accel = max(imu.gyro_scale, 1e-12), max(imu.accel_scale, 1e-12)
    return (find_spikes(t, w_i, TURN_STEP / gyro) | isolated_outliers(w_i, SINGLE_TURN / gyro)
            | find_spikes(t, f_i, FORCE_STEP / accel)
            | isolated_outliers(f_i, SINGLE_FORCE / accel))


def speed_glitches(t: Floats, speed: Floats) -> Bools:
    """Return a mask of odometer speeds that are spikes: (n,) bool."""
    if len(speed) < 20:
        return np.zeros(len(speed), bool)
    top = np.percentile(np.abs(speed), 95)
    speed_step = 0.3    # of the top speed, least jump from row to row of a glitch
    return find_spikes(t, speed[:, None], max(speed_step * top, 1e-12))


def frozen_gyro_reasons(t: Floats, w: Floats, travel: Travel, limit: float) -> tuple[Reason, ...]:
    """
    Return IMU_GAP if the gyro repeats exactly one value while the wheels roll.

    t, w : (n,), (n, 3) IMU rows.   travel : Travel.   limit : s, longest allowed gap.
    Accepted are a gyro that measures zero (some drivers have a dead band) and one that often
    repeats its value (coarse steps).
    """
    if len(t) < 2 or len(travel.t) < 2:
        return ()
    same = by_step(lambda w: reduce_columns(np.logical_and, w[1:] == w[:-1])
                   & reduce_columns(np.logical_or, w[1:] != 0), w)
    where = runs(same)
    begin, end = t[where].T
    speed = np.abs(np.diff(travel.s)) / np.maximum(np.diff(travel.t), 1e-6)
    rolled = np.abs(travel.at(end) - travel.at(begin)) / np.maximum(end - begin, 1e-6)
    held = np.flatnonzero((end - begin > limit) & (rolled > ROLLS * np.percentile(speed, 95)))
    elsewhere = len(same) - np.diff(where[held]).sum()
    coarse_share = 0.2      # judgement: of the rows elsewhere; fine gyros have no repeats
    if not len(held) or same.sum() - np.diff(where[held]).sum() > coarse_share * elsewhere:
        return ()
    worst = held[np.argmax((end - begin)[held])]
    return (Reason(Code.IMU_GAP, 'the gyro repeats one value for '
                   f'{end[worst] - begin[worst]:.2f} s at t = {begin[worst]:.2f} s while the '
                   'wheels turn: its output is frozen'),)


def saturation_reasons(t_imu: Floats, w_i: Floats, f_i: Floats,
                       imu: ImuConfig) -> tuple[Reason, ...]:
    """Return IMU_SATURATED for the axis of (n, 3) raw rates or forces most often at its limit."""
    found = []
    for sensor, x_i, scale, unit, least in (
            ('gyro', w_i, imu.gyro_scale, 'rad/s', LEAST_GYRO),
            ('accelerometer', f_i, imu.accel_scale, 'm/s^2', LEAST_ACCELEROMETER)):
        for axis, x in zip('xyz', columns(x_i), strict=True):
            for peak, inside, none in ((np.max, np.less, -np.inf), (np.min, np.greater, np.inf)):
                limit = peak(x, initial=0.0)
                at = x == limit
                count, size = int(np.count_nonzero(at)), abs(limit * scale)
                if size < least or count < FEWEST_AT_LIMIT:
                    continue
                following = peak(x, where=inside(x, limit), initial=none)
                if count > TIMES_NEXT * np.count_nonzero(x == following):
                    found.append((count, float(t_imu[at.argmax()]),
                                  f'{sensor} {axis} saturates at {limit * scale:+.4g} {unit}'))
    if not found:
        return ()
    count, t, words = max(found)
    others = f'; other axis limits reached: {len(found) - 1}' if len(found) > 1 else ''
    return (Reason(Code.IMU_SATURATED, f'{words} in {count} of {len(t_imu)} messages, first at '
                   f't = {t:.1f} s{others}'),)
