# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Sampling times of odometer rows that arrive late: in bursts, or all with random delays.

A counter without a header is stamped at arrival: a delayed message (serial line, busy machine)
looks like a wheel that slides and then spins. The sender's rhythm, its evenly spaced sampling
times, is estimated from the rows with the smallest delays, or from medians. The median delay
remains; delays beyond it are removed if travel is smoother on the rhythm. Rows of a burst that do
not fit the rhythm, because rows were lost, get times by their travel.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints, median, running_sum, runs
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.even_imu_times import MIN_STEP, TESTED_ROWS
from odocal_ros.screening.odometer_rows import counter_steps

ON_TIME_WINDOW = 5.0      # s, judgement: some row in it is on time
NODE_STEP = 5             # judgement: rows between the nodes of the cubic that predicts a row
# definition: nodes relative to the row. With a line, half the acceleration would look like delay
NODES = (-2 * NODE_STEP, -NODE_STEP, NODE_STEP, 2 * NODE_STEP)
MEDIAN_WINDOW = 20.0      # s, judgement: minimum length for the median delay
MEDIAN_SIGMA = 5e-4       # s, judgement: required sigma of this median; 1 cm at 15 m/s
MIN_JITTER = 1e-4       # s, judgement: smallest deviation from the rhythm that is corrected
ROUNDING_COUNTS = 2.5     # judgement: largest deviation of a row by rounding


class Rhythm(NamedTuple):
    """Evenly spaced sampling times of rows."""

    roughness: float    # of travel at these times, over that at the stamps
    interval: float     # s
    t: Floats           # (n,) s


def sampling_times(samples: OdometerSamples, t: Floats, form: OdometerForm,
                   name: str = 'odometer') -> tuple[Floats, list[Reason]]:
    """Return the sampling times, (n,) s, of rows stamped at t, and the reason if rows are late."""
    if len(t) < 4 * NODE_STEP:
        return t, []
    is_integer = np.issubdtype(samples.value.dtype, np.integer)
    if form.quantity == 'rate':
        # a speed is as smooth as travel, but does not determine the time of a row in a burst
        rhythm, is_regular = _smoothest_rhythm(t, samples.value.astype(float))
        sampled_t = _rising(rhythm.t) if is_regular else t
    else:
        step = (counter_steps(samples.value, form.modulus) if form.quantity == 'cumulative'
                else samples.value[1:].astype(float))
        sampled_t = _correct_bursts(t, running_sum(step), ROUNDING_COUNTS if is_integer else 0.0)
    delay = t - sampled_t
    min_delay, min_share = 0.02, 0.3    # s, of an interval: larger delays are reported
    late = delay > max(min_delay, min_share * intervals(t)[0])
    if not late.any():
        return sampled_t, []
    latest, bursts = int(np.argmax(delay)), int((np.diff(late.astype(int)) == 1).sum())
    return sampled_t, [Reason(
        Code.ODOMETER_LATE, f'{int(late.sum())} of {len(t)} {name} messages arrived late, in '
        f'{max(bursts, 1)} burst{"s" * (bursts > 1)}, by up to {delay[latest]:.3g} s at t = '
        f'{t[latest]:.2f} s; moved back to their estimated times')]


def arrival_jitter(t: Floats) -> float | None:
    """Return the standard deviation of arrivals from the rhythm, s, None with few rows."""
    if len(t) < 4 * NODE_STEP or t[-1] <= t[0]:
        return None
    # the middle 95 % of a normal distribution are four sigmas
    return float(min(np.subtract(*np.percentile(t - _rhythm_of_earliest(t, interval), [97.5, 2.5]))
                     / 4 for interval in intervals(t)))


def intervals(t: Floats) -> list[float]:
    """Return the possible intervals of the sender, s: with lost rows counted, and without."""
    window_s = 5.0    # over which means are taken
    n = max(1, int(window_s * (len(t) - 1) / max(t[-1] - t[0], window_s)))      # its rows
    step, duration = np.diff(t), t[n:] - t[:-n]
    usual_s = median(step)
    mean_s = median(duration) / n
    if not mean_s:      # most rows have the same stamp
        mean_s = float(t[-1] - t[0]) / len(step)
    max_difference = 0.005    # of the mean; if larger, rows are lost or have random delays
    if abs(mean_s - usual_s) < max_difference * mean_s:
        return [mean_s]
    min_share = 0.3    # of the intervals, within a quarter of the usual one
    is_even = np.mean(np.abs(step - usual_s) < usual_s / 4) > min_share
    # if more than half of the rows are lost, the median is not the interval
    if not is_even or usual_s < mean_s / 2:
        return [mean_s]
    sent_rows = running_sum(np.round(step / usual_s))    # number of rows, with the lost ones
    return [median(duration / np.maximum(sent_rows[n:] - sent_rows[:-n], 1.0)), mean_s]


def _correct_bursts(t: Floats, travel: Floats, rounding: float) -> Floats:
    """Return the sampling times of rows of travel, (n,); rounding: largest error of travel."""
    rhythm, is_regular = _smoothest_rhythm(t, travel)
    min_delay, delay_share = 0.004, 0.1    # s, of an interval: the larger is the limit
    late = t - rhythm.t > (rhythm.interval if is_regular else
                           max(min_delay, delay_share * rhythm.interval))
    sampled_t = (rhythm.t if is_regular else t).copy()
    spans = runs(late)
    fits_rhythm = _fits_rhythm(spans, t, rhythm.t, travel, late, rounding)
    for (begin, end), fits in zip(spans.tolist(), fits_rhythm.tolist(), strict=True):
        if fits:
            sampled_t[begin:end] = rhythm.t[begin:end]
        elif begin > 0 and end < len(t):
            sampled_t[begin:end] = _times_by_travel(t, travel, begin - 1, end, rhythm.interval)
    return _rising(sampled_t)


def _rising(t: Floats) -> Floats:
    """Return strictly rising times: each at least MIN_STEP after the previous one."""
    order = MIN_STEP * np.arange(len(t))
    return np.asarray(np.maximum.accumulate(t - order) + order)


def _fits_rhythm(spans: Ints, t: Floats, even: Floats, travel: Floats, late: Bools,
                rounding: float) -> Bools:
    """Return True for each span of late rows, (k, 2), in which travel fits even times, (n,) s."""
    begin, end = spans.T
    if not len(begin):
        return np.zeros(0, bool)
    low, high = np.maximum(begin - NODE_STEP, 0), np.minimum(end + NODE_STEP, len(t))
    is_tested = np.zeros(len(t) + 1, bool)
    for shift in range(-NODE_STEP, NODE_STEP + 1):
        is_tested[np.clip(np.flatnonzero(late) + shift, 0, len(t) - 1)] = True
    deviation = np.zeros((2, len(t) + 1))      # at stamps and at even times
    rows = np.flatnonzero(is_tested)
    deviation[:, rows] = [_cubic_deviation(x, travel, rows) for x in (t, even)]
    # reduceat gives a sum for each run, and one between runs, which is not used
    ends = np.stack([low, high], -1).ravel()
    at_stamps, at_even = np.sqrt(np.add.reduceat(deviation**2, ends, axis=1)[:, ::2])
    largest = np.maximum.reduceat(np.abs(deviation[1]), ends)[::2]
    fitting_share = 0.25    # of the deviation at the stamps: more remains if a row is lost
    return np.asarray((largest <= rounding) | (at_even < fitting_share * at_stamps))


def _smoothest_rhythm(t: Floats, travel: Floats) -> tuple[Rhythm, bool]:
    """Return the rhythm at which travel is smoothest, and True if rows are sampled on it."""
    # of equally smooth ones the first is used, by medians: that of the earliest rows has steps
    rhythms = [Rhythm(_roughness(t, even, travel), interval, even)
               for interval in reversed(intervals(t))
               for even in (*_rhythm_of_median(t, interval), _rhythm_of_earliest(t, interval))]
    lowest = min(rhythm.roughness for rhythm in rhythms)
    # judgement: of a rhythm on which rows are sampled; of equal ones, over the lowest
    max_roughness, equal_ratio = 0.9, 1.1
    if lowest >= max_roughness:
        return rhythms[-1], False
    return next(rhythm for rhythm in rhythms if rhythm.roughness <= equal_ratio * lowest), True


def _roughness(t: Floats, even: Floats, travel: Floats) -> float:
    """Return the roughness of travel at even times over that at t, from rows that differ."""
    rows = np.flatnonzero(np.abs(t - even) > MIN_JITTER)
    rows = rows[::1 + len(rows) // TESTED_ROWS]
    deviation = np.array([np.abs(_cubic_deviation(x, travel, rows)) for x in (t, even)])
    deviation = deviation[:, deviation.any(axis=0)]       # of rows in motion
    if not deviation.size:
        return 1.0
    percentile = 90    # a lost row makes the rhythm wrong for some adjacent rows
    at_stamps, at_even = np.percentile(deviation, percentile, axis=1)
    return float(at_even / max(at_stamps, MIN_STEP))


def _rhythm_of_earliest(t: Floats, interval: float) -> Floats:
    """Return the rhythm of the rows with the smallest delays, by morphological opening."""
    rows = interval * np.arange(len(t))
    window = min(int(ON_TIME_WINDOW / interval) + 1, len(t))
    earliest = _running_minimum(t - rows, window)
    # in the last window, an increase by whole intervals is caused by lost rows
    last, jitter = earliest[len(t) - window:], 0.25     # of an interval: allowance for jitter
    last[:] = last[0] + interval * np.floor((last - last[0]) / interval + jitter)
    even = rows - _running_minimum(-earliest[::-1], window)[::-1]
    return even + np.median(t - even)      # a constant delay is not corrected


def _rhythm_of_median(t: Floats, interval: float) -> list[Floats]:
    """Return the rhythm by median times, with early and late rows; [] if rows are lost."""
    row = np.arange(len(t))
    lateness = t - interval * row
    middle_rows, medians = _medians(lateness, MEDIAN_WINDOW / interval)
    jitter = float(np.median(np.abs(lateness - np.interp(row, middle_rows, medians))))
    # a lost row changes the median by an interval, jitter by a tenth of its size
    step = np.diff(medians)
    if len(step) and np.abs(step - np.median(step)).max() > max(interval / 2, jitter / 2):
        return []
    line = np.polyval(np.polyfit(middle_rows, medians, min(1, len(medians) - 1)), row)
    # exponential lateness has a sigma of 1.4 jitters, its median of n rows 1.4 / sqrt(n)
    block_rows = max(MEDIAN_WINDOW / interval, (1.4 * jitter / MEDIAN_SIGMA)**2)
    return [interval * row + line + np.interp(row, *_medians(lateness - line, block_rows))]


def _medians(x: Floats, block_rows: float) -> tuple[Floats, Floats]:
    """Return the middle rows of blocks of about ``block_rows`` rows, and their medians."""
    blocks = np.array_split(x, max(1, int(len(x) / block_rows)))
    size = np.array([len(block) for block in blocks])
    return np.cumsum(size) - size / 2, np.array([np.median(block) for block in blocks])


def _running_minimum(x: Floats, count: int) -> Floats:
    """Return the minimum of each value and those after it, ``count`` in total."""
    n, count = len(x), min(count, len(x))       # an invalid interval may give any number
    # van Herk: a window is the end of a block and the start of the next one
    blocks = np.append(x, np.full(count - n % count + count, np.inf)).reshape(-1, count)
    from_first = np.minimum.accumulate(blocks, axis=1).ravel()
    to_last = np.minimum.accumulate(blocks[:, ::-1], axis=1)[:, ::-1].ravel()
    return np.minimum(to_last[:n], from_first[count - 1:count - 1 + n])


def _cubic_deviation(t: Floats, travel: Floats, rows: Ints) -> Floats:
    """Return the deviation of the travel of rows from the cubic through adjacent rows: (m,)."""
    last = len(t) - 1
    nodes = [np.clip(rows + step, 0, last) for step in NODES]
    times, t_row = [t[node] for node in nodes], t[rows]
    predicted = np.zeros(len(rows))      # Lagrange's form of the cubic, minus travel
    for node, time in zip(nodes, times, strict=True):
        weight = np.ones(len(rows))
        for other in times:
            if other is not time:
                difference = time - other        # 0 for simultaneous rows, or at an end
                weight *= (t_row - other) / np.where(np.abs(difference) > 1e-9, difference, 1e-9)
        predicted += weight * (travel[node] - travel[rows])
    return np.where((rows + NODES[0] >= 0) & (rows + NODES[-1] <= last), -predicted, 0.0)


def _times_by_travel(t: Floats, travel: Floats, before: int, after: int,
                     interval: float) -> Floats:
    """Return the times of the rows between two rows: by travel if they are a burst, else t."""
    # a burst is short, and its apparent speed far above the adjacent speeds: constant speed is
    # assumed
    rows = np.arange(before + 1, after)

    def speed(first: int, last: int) -> float:
        first, last = max(first, 0), min(last, len(t) - 1)
        return float(abs(travel[last] - travel[first]) / max(t[last] - t[first], interval / 10))

    adjacent = max(speed(before - NODE_STEP, before), speed(after, after + NODE_STEP))
    max_duration = 1.0    # s within which speed is almost constant
    min_ratio = 3.0       # of apparent over adjacent speed: larger than of a wheel
    duration, distance = t[after] - t[before], travel[after] - travel[before]
    is_burst = (duration <= max_duration and adjacent
                and speed(before + 1, after) >= min_ratio * adjacent)
    if not is_burst or distance == 0:
        return t[rows]
    by_travel = t[before] + (travel[rows] - travel[before]) * duration / distance
    return np.maximum.accumulate(np.clip(by_travel, t[before], t[rows]))
