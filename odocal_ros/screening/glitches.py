# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of values that are no measurements: impossible, isolated, frozen, or saturated.

In: raw columns of a topic. Out: masks of rows, or reasons. A glitch is a spike (a jump away and
back, in motion too) or an isolated outlier (without motion).
"""

from dataclasses import replace
from functools import reduce
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import (
    Bools,
    columns,
    Floats,
    lengths,
    map_rows,
    map_windows,
    median,
    reduce_columns,
    runs,
    thinned,
)
from odocal_ros.data.samples import HeadingSamples, ImuSamples
from odocal_ros.nav.odometer import Travel
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.nominal import G

# judgement: far beyond any sensor in any unit in use (deg/s, mm/s^2): wrong units are kept
BEYOND_SENSOR = {'w_i': 1e3, 'f_i': 1e5, 'value': 1e15, 'velocity_n': 1e5, 'q_ni': 10.0}
# judgement: least number of impossible rows in a group, each within GROUP_GAP of the one before
GROUP_ROWS = 5
GROUP_GAP = 50          # rows: about a page or a packed block of a recording
# judgement: least share, or least number, of impossible rows in a damaged recording: others
# near them may be false too
DAMAGED_SHARE, SEVERAL_ROWS = 0.01, 4
NEIGHBOUR_ROWS = 5          # rows without motion on each side of an isolated outlier
# judgement, of a spike: least step from row to row, rad/s and m/s^2 (potholes are kept), and least
# ratio of it to the median step; longest duration, s; largest share of the step that remains
SPIKE_RATE, SPIKE_FORCE, SPIKE_RATIO = 0.8, 50.0, 20.0
SPIKE_TIME, RETURN_SHARE = 0.4, 0.5
# judgement, of an isolated outlier: least deviation from the mean of its two neighbours, rad/s
# (0.003 rad in 0.1 s) and m/s^2, and least ratio of it to those of adjacent rows; largest
# difference of its neighbours, over the deviation
SINGLE_RATE, SINGLE_FORCE, SINGLE_RATIO = 0.03, 2.0, 10.0
EQUAL_NEIGHBOURS = 0.3
GLITCH_SHARE = 0.002      # largest share of glitches; with more, they are normal for the sensor
ROLLING_SHARE = 0.1               # of the top speed: least mean speed of a moving vehicle
# physical: smaller than the range of any sensor, larger than gravity at rest
MIN_GYRO_RANGE, MIN_ACCELEROMETER_RANGE = 1.0, 1.5 * G      # rad/s, m/s^2
# statistical: coarse steps also repeat the largest value, but less often than the next smaller one
MIN_AT_LIMIT, MIN_COUNT_RATIO = 5, 3.0
# judgement, of a dead band of the gyro: least share of zeros in motion, least number of different
# rates up to twice the smallest one (coarse steps have one), and rows that are tested
ZERO_SHARE, MIN_NEXT_RATES, DEAD_BAND_ROWS = 0.05, 5, 200_000
Oriented = TypeVar('Oriented', ImuSamples, HeadingSamples)


def is_impossible(name: str, column: NDArray[Any]) -> Bools:
    """Return a mask of rows with NaN, Inf or an impossible value: (n, ...) to (n,) bool."""
    column = np.asarray(column)
    if np.issubdtype(column.dtype, np.integer):
        return np.zeros(len(column), bool)
    largest_value = 1e300    # of unbounded columns: sums and products with it stay finite
    max_value = BEYOND_SENSOR.get(name, largest_value)

    def is_outside(x: NDArray[Any]) -> Bools:
        size = np.abs(x)
        # smaller values, except 0, are damaged: judgement. Two rotations by right angles leave
        # 1e-68 of a value in axes of exact zeros
        min_value = 1e-80
        possible = (size <= max_value) & ((size >= min_value) | (size == 0))
        return ~(possible if x.ndim == 1 else reduce_columns(np.logical_and, possible))
    with np.errstate(invalid='ignore'):
        return map_rows(is_outside, column)


def without_invalid_orientations(samples: Oriented) -> Oriented:
    """Return IMU or heading rows; an invalid orientation becomes 0, its yaw variance NaN."""
    def is_invalid(impossible: Bools, q_ni: Floats, variance: Floats) -> Bools:
        length = lengths(np.where(impossible[:, None], 0.0, q_ni))
        max_length = 2.0    # of a quaternion, and of the inverse
        max_variance = 1e12    # rad^2, drivers use smaller values for unknown
        return ((length < 1 / max_length) | (length > max_length)
                | (np.abs(variance) > max_variance))

    impossible = is_impossible('q_ni', samples.q_ni)
    invalid = map_rows(is_invalid, impossible, samples.q_ni, samples.yaw_variance)
    if not (impossible | invalid & ~np.isnan(samples.yaw_variance)).any():
        return samples
    return replace(samples, q_ni=np.where(invalid[:, None], 0.0, samples.q_ni),
                   yaw_variance=np.where(invalid, np.nan, samples.yaw_variance))


def near_impossible_groups(impossible: Bools) -> Bools:
    """
    Return a mask of rows in or near a group of impossible rows: (n,) bool.

    In a damaged recording only some false rows are impossible values. The mask contains each
    group, and on each side twice as many rows as the largest distance of its impossible rows.
    """
    suspect = np.zeros(len(impossible), bool)
    rows = np.flatnonzero(impossible)
    for group in np.split(rows, np.flatnonzero(np.diff(rows) > GROUP_GAP) + 1):
        if len(group) >= GROUP_ROWS:
            margin = 2 * int(np.diff(group).max())
            suspect[max(group[0] - margin, 0):group[-1] + margin + 1] = True
    return suspect


def find_spikes(t: Floats, x: Floats, min_step: float) -> Bools:
    """
    Return a mask of rows that jump away from their neighbours and back: (n,) bool.

    t : (n,) s, rising.   x : (n, k) values.   min_step : smallest step of a spike from row to row.
    All False if so many rows jump that it is normal for the sensor.
    """
    is_spike = np.zeros(len(x), bool)
    steps = map_windows(lambda x: reduce_columns(np.maximum, np.abs(np.diff(x, axis=0))), x)
    large = np.flatnonzero(steps > min_step)
    if not len(large):
        return is_spike
    jumps = large[steps[large] > SPIKE_RATIO * median(steps)]
    end = -1      # of the last spike
    max_jumps = 2000    # jumps that are tested
    for row in jumps[:max_jumps]:
        if row < end:
            continue
        stop = np.searchsorted(t, t[row] + SPIKE_TIME, side='right')
        has_returned = np.abs(x[row + 2:stop] - x[row]).max(axis=1) <= RETURN_SHARE * steps[row]
        if has_returned.any():
            end = row + 2 + int(np.argmax(has_returned))
            is_spike[row + 1:end] = True
    return is_spike if is_spike.mean() <= GLITCH_SHARE else np.zeros(len(x), bool)


def isolated_outliers(x: Floats, min_deviation: float) -> Bools:
    """
    Return a mask of isolated outliers with no motion before and after.

    x : (n, k).   min_deviation : of an outlier.   Returns (n,) bool, all False if there are so
    many that it is normal for the sensor.
    """
    edge = NEIGHBOUR_ROWS + 1      # rows at each end that are not tested

    def is_outlier(x: Floats) -> Bools:
        m = len(x) - 2 * edge      # tested rows
        deviations = np.abs(x[1:-1] - (x[:-2] + x[2:]) / 2)
        if not (deviations > min_deviation).any():
            return np.zeros(m, bool)
        # the largest deviation of nearby rows; the adjacent ones deviate because of the outlier
        nearby = reduce(np.maximum, (deviations[NEIGHBOUR_ROWS + k:][:m]
                                     for d in range(2, edge) for k in (-d, d)))
        deviation = deviations[NEIGHBOUR_ROWS:][:m]
        difference = np.abs(x[edge + 1:][:m] - x[NEIGHBOUR_ROWS:][:m])
        is_isolated: Bools = ((deviation > np.maximum(min_deviation, SINGLE_RATIO * nearby))
                              & (difference < EQUAL_NEIGHBOURS * deviation))
        return reduce_columns(np.logical_or, is_isolated)

    outliers = np.zeros(len(x), bool)
    if len(x) > 2 * edge:
        outliers[edge:-edge] = map_windows(is_outlier, x, following=2 * edge)
    outliers &= outliers.sum() <= max(GLITCH_SHARE * len(x), GROUP_ROWS)
    return outliers


def imu_glitches(t: Floats, w_i: Floats, f_i: Floats, imu: ImuConfig) -> Bools:
    """Return a mask of IMU rows that are spikes or isolated outliers; imu : its scale factors."""
    gyro, accel = max(imu.gyro_scale, 1e-12), max(imu.accel_scale, 1e-12)
    return (find_spikes(t, w_i, SPIKE_RATE / gyro) | isolated_outliers(w_i, SINGLE_RATE / gyro)
            | find_spikes(t, f_i, SPIKE_FORCE / accel)
            | isolated_outliers(f_i, SINGLE_FORCE / accel))


def speed_glitches(t: Floats, speed: Floats) -> Bools:
    """Return a mask of odometer speeds that are spikes: (n,) bool."""
    if len(speed) < 20:
        return np.zeros(len(speed), bool)
    top = np.percentile(np.abs(speed), 95)
    min_share = 0.3    # of the top speed, least step from row to row
    return find_spikes(t, speed[:, None], max(min_share * top, 1e-12))


def frozen_gyro_spans(t: Floats, w: Floats, travel: Travel, limit: float) -> Floats:
    """
    Return begin and end, s, (k, 2), where a gyro repeats exactly one value while the wheels roll.

    t, w : (n,) s, (n, 3) rad/s.   travel : of the odometer.   limit : s, longest allowed gap.
    Accepted are a gyro that measures zero (``dead_band_reasons``) and one that often repeats its
    value (coarse steps).
    """
    if len(t) < 2 or len(travel.t) < 2:
        return np.empty((0, 2))
    repeats = map_windows(lambda w: reduce_columns(np.logical_and, w[1:] == w[:-1])
                          & reduce_columns(np.logical_or, w[1:] != 0), w)
    spans = runs(repeats)
    begin, end = t[spans].T
    speed = np.abs(np.diff(travel.s)) / np.maximum(np.diff(travel.t), 1e-6)
    mean_speed = np.abs(travel.at(end) - travel.at(begin)) / np.maximum(end - begin, 1e-6)
    frozen = ((end - begin > limit)
              & (mean_speed > ROLLING_SHARE * np.percentile(speed, 95)))
    frozen_rows = np.diff(spans[frozen]).sum()
    coarse_share = 0.2      # judgement: share of the other rows; fine gyros have no repeats
    is_coarse = repeats.sum() - frozen_rows > coarse_share * (len(repeats) - frozen_rows)
    return np.empty((0, 2)) if is_coarse else t[spans[frozen]]


def frozen_gyro_reasons(t: Floats, w: Floats, travel: Travel, limit: float) -> tuple[Reason, ...]:
    """Return IMU_GAP for the longest of the spans that ``frozen_gyro_spans`` returns."""
    frozen = frozen_gyro_spans(t, w, travel, limit)
    if not len(frozen):
        return ()
    begin, end = frozen[np.argmax(np.diff(frozen)[:, 0])]
    return (Reason(Code.IMU_GAP, f'the gyro repeats one value for {end - begin:.2f} s at '
                   f't = {begin:.2f} s while the wheels turn (limit {limit:g} s): its output is '
                   'frozen'),)


def dead_band_reasons(t: Floats, w: Floats, travel: Travel) -> tuple[Reason, ...]:
    """Return GYRO_DEAD_BAND if rates w, (n, 3) rad/s, are 0 if small, while the wheels roll."""
    if len(t) < 2 or len(travel.t) < 2:
        return ()
    t, w = thinned(t, DEAD_BAND_ROWS), thinned(w, DEAD_BAND_ROWS)
    seconds = np.arange(t[0], t[-1] + 1.0)
    speed = np.abs(np.diff(travel.at(seconds), append=travel.s[-1]))
    in_motion = np.interp(t, seconds + 0.5, speed) > ROLLING_SHARE * np.percentile(speed, 95)
    dead_bands = []      # share of zeros, axis, smallest rate, deg/s
    for axis, x in zip('xyz', np.abs(w[in_motion]).T, strict=True):
        smallest = np.min(x, where=x > 0, initial=np.inf)
        zeros = float((x == 0).mean()) if len(x) else 0.0
        next_rates = np.unique(np.round(x[(x > 0) & (x < 2 * smallest)] / smallest, 2))
        if zeros > ZERO_SHARE and len(next_rates) >= MIN_NEXT_RATES:
            dead_bands.append((zeros, axis, np.rad2deg(smallest)))
    if not dead_bands:
        return ()
    zeros, axis, limit_deg = max(dead_bands)
    return (Reason(Code.GYRO_DEAD_BAND, f'the gyro sends 0 for turn rates below {limit_deg:.2g} '
                   f'deg/s, on axis {axis} in {100 * zeros:.0f} % of the messages in motion'),)


def saturation_reasons(t_imu: Floats, w_i: Floats, f_i: Floats,
                       imu: ImuConfig) -> tuple[Reason, ...]:
    """Return IMU_SATURATED for the axis of (n, 3) raw rates or forces most often at its limit."""
    saturated = []      # rows at the limit, time of the first, s, text
    for sensor, x_i, scale, unit, min_limit in (
            ('gyro', w_i, imu.gyro_scale, 'rad/s', MIN_GYRO_RANGE),
            ('accelerometer', f_i, imu.accel_scale, 'm/s^2', MIN_ACCELEROMETER_RANGE)):
        for axis, x in zip('xyz', columns(x_i), strict=True):
            # the largest value, then the smallest; ``is_inside`` selects all other values
            for extreme, is_inside, no_value in ((np.max, np.less, -np.inf),
                                                 (np.min, np.greater, np.inf)):
                limit = extreme(x, initial=0.0)
                at_limit = x == limit
                count, size = int(np.count_nonzero(at_limit)), abs(limit * scale)
                if size < min_limit or count < MIN_AT_LIMIT:
                    continue
                next_value = extreme(x, where=is_inside(x, limit), initial=no_value)
                if count > MIN_COUNT_RATIO * np.count_nonzero(x == next_value):
                    saturated.append((count, float(t_imu[at_limit.argmax()]),
                                      f'{sensor} {axis} saturates at {limit * scale:+.4g} {unit}'))
    if not saturated:
        return ()
    count, t, text = max(saturated)
    others = f'; other axis limits reached: {len(saturated) - 1}' if len(saturated) > 1 else ''
    return (Reason(Code.IMU_SATURATED, f'{text} in {count} of {len(t_imu)} messages, first at '
                   f't = {t:.1f} s{others}'),)
