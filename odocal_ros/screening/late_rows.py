# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Sampling times of odometer rows that arrive late: in bursts, or all with random delays.

A counter without a header is stamped at arrival: a delayed message (serial line, busy machine)
looks like a wheel that slides and then spins. The sender's rhythm (even times) is by the rows with
the smallest delays. The median delay remains; the rest is removed if travel is smoother on the
rhythm. Rows of a burst that are not on it get times by their travel.
"""

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints, median, running_sum, runs
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.even_imu_times import LEAST_STEP, TESTED_ROWS
from odocal_ros.screening.odometer_rows import counter_steps

ON_TIME_WINDOW = 5.0      # s, judgement: some row in it is on time
EVEN_BESIDE = 5           # judgement: rows to either side that determine the time of a row
# definition: with a line, half the acceleration would look like delay
CUBIC = (-2 * EVEN_BESIDE, -EVEN_BESIDE, EVEN_BESIDE, 2 * EVEN_BESIDE)
MIDDLE_WINDOW = 20.0      # s, judgement: minimum length for the median delay
MIDDLE_SIGMA = 5e-4       # s, judgement: required sigma of this median; 1 cm at 15 m/s
LEAST_JITTER = 1e-4       # s, judgement: smallest deviation from the rhythm that is corrected
ROUNDING_COUNTS = 2.5     # judgement: largest deviation of a row by rounding


def sampling_times(samples: OdometerSamples, t: Floats, form: OdometerForm, found: list[Reason],
                   name: str = 'odometer') -> Floats:
    """Return the sampling times of rows stamped at t, (n,) s: late ones are moved back."""
    if len(t) < 4 * EVEN_BESIDE:
        return t
    whole = np.issubdtype(samples.value.dtype, np.integer)
    if form.quantity == 'rate':
        # a speed is as smooth as travel, but does not determine the time of a row in a burst
        _, even, is_smoother = _smoothest_rhythm(t, samples.value.astype(float))
        true = _rising(even) if is_smoother else t
    else:
        step = (counter_steps(samples.value, form.modulus) if form.quantity == 'cumulative'
                else samples.value[1:].astype(float))
        travel = running_sum(step)
        true = _correct_bursts(t, travel, ROUNDING_COUNTS if whole else 0.0)
    late = t - true
    named_late, named_late_share = 0.02, 0.3    # s, of an interval: larger delays are reported
    named = late > max(named_late, named_late_share * intervals(t)[0])
    if named.any():
        worst, times = int(np.argmax(late)), int((np.diff(named.astype(int)) == 1).sum())
        found.append(Reason(Code.ODOMETER_LATE, f'{int(named.sum())} of {len(t)} {name} messages '
                            f'arrived late, in {max(times, 1)} burst{"s" * (times > 1)}, by up '
                            f'to {late[worst]:.3g} s at t = {t[worst]:.2f} s; moved back to '
                            'their estimated times'))
    return true


def arrival_jitter(t: Floats) -> float | None:
    """Return the standard deviation of arrivals from the rhythm, s, None with few rows."""
    if len(t) < 4 * EVEN_BESIDE or t[-1] <= t[0]:
        return None
    late = [t - _rhythm_of_earliest(t, usual) for usual in intervals(t)]
    # of the middle 95 %, four sigmas of a normal distribution
    return float(min(np.subtract(*np.percentile(x, [97.5, 2.5])) / 4 for x in late))


def intervals(t: Floats) -> list[float]:
    """Return candidates of the sender's interval, s: by all sent rows, and by received ones."""
    interval_span = 5.0    # s over which means are taken
    n = max(1, int(interval_span * (len(t) - 1) / max(t[-1] - t[0], interval_span)))
    step = np.diff(t)
    # if most rows have the same stamp, the median over parts is zero
    usual = median(step)
    mean = median(t[n:] - t[:-n]) / n or float(t[-1] - t[0]) / len(step)
    steady_share = 0.005    # larger difference: rows are lost, or all have random delays
    if abs(mean - usual) < steady_share * mean:
        return [mean]
    even_share = 0.3    # share of the intervals that are within a quarter of the usual one
    even = np.mean(np.abs(step - usual) < usual / 4) > even_share
    # if more than half are lost, the median is not the interval
    if not even or usual < mean / 2:
        return [mean]
    sent = running_sum(np.round(step / usual))    # with the lost rows
    return [median((t[n:] - t[:-n]) / np.maximum(sent[n:] - sent[:-n], 1.0)), mean]


def _correct_bursts(t: Floats, travel: Floats, least: float) -> Floats:
    usual, even, is_smoother = _smoothest_rhythm(t, travel)
    least_late, late_share = 0.004, 0.1    # s, of an interval: the larger is the limit
    late = t - even > (usual if is_smoother else max(least_late, late_share * usual))
    true = even.copy() if is_smoother else t.copy()
    for begin, end, fits in _fitting_runs(t, even, travel, late, least):
        if fits:
            true[begin:end] = even[begin:end]
        elif begin > 0 and end < len(t):
            true[begin:end] = _times_by_travel(t, travel, begin - 1, end, usual)
    return _rising(true)


def _rising(t: Floats) -> Floats:
    """Return strictly rising times: each at least APART after the previous one."""
    order = LEAST_STEP * np.arange(len(t))
    out: Floats = np.maximum.accumulate(t - order) + order
    return out


def _fitting_runs(t: Floats, even: Floats, travel: Floats, late: Bools,
                  least: float) -> list[tuple[int, int, bool]]:
    """Return begin and end of the runs of late rows, and True if they fit the rhythm."""
    begin, end = runs(late).T
    if not len(begin):
        return []
    low, high = np.maximum(begin - EVEN_BESIDE, 0), np.minimum(end + EVEN_BESIDE, len(t))
    about = np.zeros(len(t) + 1, bool)      # tested rows
    for shift in range(-EVEN_BESIDE, EVEN_BESIDE + 1):
        about[np.clip(np.flatnonzero(late) + shift, 0, len(t) - 1)] = True
    off = np.zeros((2, len(t) + 1))
    rows = np.flatnonzero(about)
    off[:, rows] = [_cubic_deviation(x, travel, rows) for x in (t, even)]
    # by reduceat, between the ends of each run
    ends = np.stack([low, high], -1).ravel()
    sent, put = np.sqrt(np.add.reduceat(off**2, ends, axis=1)[:, ::2])
    most = np.maximum.reduceat(np.abs(off[1]), ends)[::2]
    fitting_share = 0.25    # of the deviation at the stamps: more remains if a row is lost
    fits = (most <= least) | (put < fitting_share * sent)
    return list(zip(begin.tolist(), end.tolist(), fits.tolist(), strict=True))


def _smoothest_rhythm(t: Floats, travel: Floats) -> tuple[float, Floats, bool]:
    """Return the interval, times on the smoothest rhythm, True if travel is smoother on it."""
    # of two equally smooth ones, that of the median rows: the earliest rows have steps
    found = [(_unevenness(t, even, travel), usual, even) for usual in reversed(intervals(t))
             for even in (*_rhythm_of_median(t, usual), _rhythm_of_earliest(t, usual))]
    least = min(ratio for ratio, _, _ in found)
    evener_share, as_even = 0.9, 1.1
    is_smoother = least < evener_share
    _, usual, even = next(
        x for x in found if x[0] <= as_even * least) if is_smoother else found[-1]
    return usual, even, is_smoother


def _unevenness(t: Floats, even: Floats, travel: Floats) -> float:
    """Return roughness of travel on a rhythm over that at t, by rows that are not on it."""
    rows = np.flatnonzero(np.abs(t - even) > LEAST_JITTER)
    rows = rows[::1 + len(rows) // TESTED_ROWS]
    off = np.array([np.abs(_cubic_deviation(x, travel, rows)) for x in (t, even)])
    off = off[:, off.any(axis=0)]       # of rows in motion
    if not off.size:
        return 1.0
    most = 90    # percentile: a lost row makes the rhythm wrong for some adjacent rows
    sent, put = np.percentile(off, most, axis=1)
    return float(put / max(sent, LEAST_STEP))


def _rhythm_of_earliest(t: Floats, usual: float) -> Floats:
    """Return the rhythm of the rows with the smallest delays, by morphological opening."""
    rows = usual * np.arange(len(t))
    window = min(int(ON_TIME_WINDOW / usual) + 1, len(t))
    least = _running_minimum(t - rows, window)
    # in the last window, an increase by whole intervals is caused by lost rows
    end, jitter = least[len(t) - window:], 0.25     # of an interval: allowance for jitter
    end[:] = end[0] + usual * np.floor((end - end[0]) / usual + jitter)
    even = rows - _running_minimum(-least[::-1], window)[::-1]
    return even + np.median(t - even)      # a constant delay is not corrected


def _rhythm_of_median(t: Floats, usual: float) -> list[Floats]:
    """Return the rhythm by median times, with early and late rows; [] if rows are lost."""
    row = np.arange(len(t))
    late = t - usual * row
    at, middle = _medians(late, MIDDLE_WINDOW / usual)
    jitter = float(np.median(np.abs(late - np.interp(row, at, middle))))
    # a lost row changes the median by an interval, jitter by a tenth of its size
    step = np.diff(middle)
    if len(step) and np.abs(step - np.median(step)).max() > max(usual / 2, jitter / 2):
        return []
    line = np.polyval(np.polyfit(at, middle, min(1, len(at) - 1)), row)
    # exponential lateness has a sigma of 1.4 jitters, its median of n rows 1.4 / sqrt(n)
    per = max(MIDDLE_WINDOW / usual, (1.4 * jitter / MIDDLE_SIGMA)**2)
    return [usual * row + line + np.interp(row, *_medians(late - line, per))]


def _medians(x: Floats, per: float) -> tuple[Floats, Floats]:
    """Return the middle rows of blocks of ``per`` rows, and their medians."""
    blocks = np.array_split(x, max(1, int(len(x) / per)))
    size = np.array([len(block) for block in blocks])
    return np.cumsum(size) - size / 2, np.array([np.median(block) for block in blocks])


def _running_minimum(x: Floats, count: int) -> Floats:
    """Return the minimum of each value and those after it, ``count`` in total."""
    n, count = len(x), min(count, len(x))       # an invalid interval may give any number
    blocks = np.append(x, np.full(count - n % count + count, np.inf)).reshape(-1, count)
    since = np.minimum.accumulate(blocks, axis=1).ravel()       # from its block's first
    until = np.minimum.accumulate(blocks[:, ::-1], axis=1)[:, ::-1].ravel()   # to its last
    return np.minimum(until[:n], since[count - 1:count - 1 + n])


def _cubic_deviation(t: Floats, travel: Floats, rows: Ints) -> Floats:
    """Return the deviation of the travel of rows from the cubic through adjacent rows: (m,)."""
    last = len(t) - 1
    nodes = [np.clip(rows + step, 0, last) for step in CUBIC]
    times, here = [t[at] for at in nodes], t[rows]
    meant = np.zeros(len(rows))
    for at, time in zip(nodes, times, strict=True):
        weight = np.ones(len(rows))
        for other in times:
            if other is not time:
                difference = time - other        # 0 for simultaneous rows, or at an end
                weight *= (here - other) / np.where(np.abs(difference) > 1e-9, difference, 1e-9)
        meant += weight * (travel[at] - travel[rows])
    return np.where((rows + CUBIC[0] >= 0) & (rows + CUBIC[-1] <= last), -meant, 0.0)


def _times_by_travel(t: Floats, travel: Floats, a: int, b: int, usual: float) -> Floats:
    """Return the times of the rows between a and b by travel; their stamps if no burst."""
    rows = np.arange(a + 1, b)

    def speed(first: int, last: int) -> float:
        first, last = max(first, 0), min(last, len(t) - 1)
        size: float = abs(travel[last] - travel[first]) / max(t[last] - t[first], usual / 10)
        return size

    beside = max(speed(a - EVEN_BESIDE, a), speed(b, b + EVEN_BESIDE))
    even_travel = 1.0    # s within which speed is almost constant
    catching_up = 3.0    # ratio to the adjacent speed, not of a wheel but of a burst
    if t[b] - t[a] > even_travel or not beside or speed(a + 1, b) < catching_up * beside:
        return t[rows]
    if travel[a] == travel[b]:      # forth and back: it gives no time
        return t[rows]
    # some rows of the burst are lost, so that its rhythm is useless
    by_travel = t[a] + (travel[rows] - travel[a]) * (t[b] - t[a]) / (travel[b] - travel[a])
    return np.maximum.accumulate(np.clip(by_travel, t[a], t[rows]))
