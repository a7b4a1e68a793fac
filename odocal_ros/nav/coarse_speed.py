# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Speeds in coarse steps: whole km/h of a car's bus, truncated or rounded, sometimes interpolated.

A value is a multiple of the step. It only determines the interval, one step wide, that contains
the speed, and its error is not noise: a cruise has one value for half a minute. Changes are
accurate: when the value changes by one step, the speed passes the edge between two intervals. When
it changes by more, each value only determines its interval. Zero is an exception: it includes all
speeds that the sender treats as rest.

Other speeds are held: repeated until they have changed by a step, as on many buses. The value
after a change is correct. Until the next change the speed is within one step of it, in the
direction of the change: half a step is added, and the error is uniform over the step, not noise.
Zeros are used unchanged: at standstill the vehicle does not move.

``find_coarse_speed`` and ``find_held_speed`` return the two kinds, from the rows of a speed.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, running_sum
from odocal_ros.nav.time_series import MISSING_INTERVALS

MIN_EDGE_SIGMA = 0.02      # judgement: in steps, minimum sigma of a speed at an edge
MIN_SPAN_STEPS = 3.0       # judgement: least range of the values, in steps
MIN_COHERENCE = 0.9     # judgement: coherence of distinct values at 1 / step; 1: all are multiples
# judgement: bins of the values' span; FFT size with zero padding; FFT size of the quick test
VALUE_BINS, FFT_SIZE, QUICK_FFT_SIZE = 2**17, 2**20, 2**18
MIN_NUMBER = 1e-300      # format: floats below it are integers of a wrong type; 1 / x overflows
MIN_HELD_SHARE = 0.3    # judgement: share of moving rows that repeat the one before
# statistical: changes needed to estimate a step; least ratio of the smallest one to their tenth
# percentile. If changes have any size, the smallest of 50 is a fifth of it; if speeds are held,
# both are one step plus the change in one row
MIN_CHANGES, MIN_SMALLEST_CHANGE = 50, 0.6


@dataclass(frozen=True, eq=False)
class SpeedInstants:
    """Speeds at m instants: value + sign * offset, with an unknown offset common to all."""

    t: Floats        # (m,) s
    value: Floats    # (m,) scale units per s
    sign: Floats     # (m,) 1 forwards, -1 backwards
    sigma: Floats    # (m,) scale units per s

    def between(self, begin: float, end: float) -> 'SpeedInstants':
        """Return the instants between two times, s."""
        inside = (self.t >= begin) & (self.t <= end)
        return SpeedInstants(*(x[inside] for x in (self.t, self.value, self.sign, self.sigma)))


@dataclass(frozen=True, eq=False)
class CoarseSpeed:
    """A speed in multiples of a step: its n rows that are not interpolated."""

    step: float      # scale units per s
    t: Floats        # (n,) s
    value: Floats    # (n,) scale units per s
    interpolated: bool = False    # True: the sender publishes interpolated rows between these

    @property
    def truncation(self) -> float:
        """Return the possible common error of all values from truncation: half a step."""
        return self.step / 2

    def mirrored(self, sign: Floats) -> 'CoarseSpeed':
        """Return the speed times signs (n,)."""
        return replace(self, value=self.value * sign)

    def time_in_motion(self, t: Floats) -> Floats:
        """Return the time in motion between n times, s, negative backwards: (n - 1,)."""
        sign = np.sign(self.value)
        total = running_sum((sign[1:] + sign[:-1]) / 2 * np.diff(self.t))
        return np.diff(np.interp(t, self.t, total))

    @cached_property
    def max_error(self) -> float:
        """Return the largest deviation of the speed from lines between rows, scale units per s."""
        change = np.abs(np.diff(self.value))
        return self.step + (float(np.percentile(change, 95)) / 4 if len(change) else 0.0)

    def travel_variance(self, t: Floats) -> Floats:
        """
        Return the variance of travel between n times, s, from rounding: (n - 1,) scale units^2.

        A run of equal values has one error, uniform in its interval, that does not average out. It
        is replaced by white noise with the same variance over the run.
        """
        first = np.flatnonzero(np.diff(self.value, prepend=np.nan))      # rows of runs
        begin = self.t[first]
        duration = np.diff(begin, append=self.t[-1])
        power = self.step**2 / 12 * duration * (self.value[first] != 0)
        total = np.interp(t, np.append(begin, self.t[-1]), running_sum(power * duration))
        # before and after a motion the speed is within a step of zero, for an unknown time
        T_moving, T = np.abs(self.time_in_motion(t)), np.diff(t)
        at_rest = np.where((T_moving > 0) & (T_moving < T), self.step * (T - T_moving), 0.0)
        return np.diff(total) + at_rest**2 / 3      # uniform within this travel to each side

    @cached_property
    def instants(self) -> SpeedInstants:
        """
        Return the speeds that the rows determine, up to the offset common to all values.

        The offset is half a step if the sender truncates, zero if it rounds. A change by one step
        gives the speed at its middle, an edge: the mean of both values, with an error uniform over
        the change of the speed between the two rows. A run of rows with one value between larger
        changes, or between rows so far apart that the speed changes by more than a step, counts as
        one row with an error uniform in its interval.
        """
        step, t, v = self.step, self.t, self.value
        multiple = np.rint(v / step)
        before = np.flatnonzero(np.diff(multiple))      # rows before a change
        after = before + 1
        steps, dt = np.abs(np.diff(multiple)[before]), np.diff(t)[before]
        t_middle, edge = (t[before] + t[after]) / 2, (v[before] + v[after]) / 2
        speed_change = _rate_limits(t_middle, edge, step) * dt
        # such a change may pass two edges, or none
        steps = np.where(speed_change > step, 2, steps)
        sizes = np.abs(multiple[before]), np.abs(multiple[after])
        min_multiple = 2    # of a value that is used: up to the first one there may be a dead band
        is_edge = (steps == 1) & (np.maximum(*sizes) >= min_multiple) & (np.minimum(*sizes) > 0)
        if not self.interpolated:
            usual_dt = np.median(np.diff(t)) if len(t) > 1 else 0.0
            is_edge &= dt <= MISSING_INTERVALS * usual_dt
        is_run = (steps[:-1] > 1) & (steps[1:] > 1) & (sizes[0][1:] >= min_multiple)
        first, length = after[:-1][is_run], np.diff(before)[is_run]
        # one row of each run, at varying places: the middle row of a run at an extremum of the
        # speed would be the fastest. Multiples of the golden ratio are evenly distributed
        golden = 0.618034
        row = first + (length * (np.arange(len(first)) * golden % 1.0)).astype(int)
        t_out, value = np.r_[t_middle[is_edge], t[row]], np.r_[edge[is_edge], v[row]]
        width = np.r_[speed_change[is_edge], np.full(len(row), step)]
        sigma = np.hypot(width / np.sqrt(12), MIN_EDGE_SIGMA * step)
        order = np.argsort(t_out, kind='stable')
        return SpeedInstants(t_out[order], value[order], np.sign(value[order]), sigma[order])


def _rate_limits(t: Floats, edge: Floats, step: float) -> Floats:
    """
    Return an upper limit of the rate of change at each edge, (m,): the larger of both sides.

    It is at least the upper quartile of the drive: a small change between two cruises is as fast
    as a large one, but has no other edge nearby. With a rate from its neighbours alone, the weight
    of an edge would depend on its error.
    """
    if len(t) < 2:
        return np.full(len(t), np.inf)      # a single change gives no rate
    between = np.maximum(np.abs(np.diff(edge)), step) / np.diff(t)
    rate = np.maximum(np.r_[0.0, between], np.r_[between, 0.0])
    return np.asarray(np.maximum(rate, np.percentile(rate, 75)))


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldSpeed(CoarseSpeed):
    """A speed held until it has changed by ``step``; ``value`` is the middle of its interval."""

    sent: Floats             # (n,) as published

    @property
    def truncation(self) -> float:
        """Return the common error of all values from truncation: 0."""
        return 0.0

    def mirrored(self, sign: Floats) -> 'HeldSpeed':
        """Return the speed times signs (n,)."""
        return replace(self, value=self.value * sign, sent=self.sent * sign)

    @cached_property
    def instants(self) -> SpeedInstants:
        """Return the speeds at changes, which are correct except for sampling."""
        v = self.sent
        row = np.flatnonzero((np.diff(v, prepend=v[:1]) != 0) & (v != 0))
        sigma = np.full(len(row), MIN_EDGE_SIGMA * self.step)
        return SpeedInstants(self.t[row], v[row], np.sign(v[row]), sigma)


def find_coarse_speed(t: Floats, value: Floats) -> CoarseSpeed | None:
    """Return a quantised speed from its rows, (n,) s, scale units per s; None if it is not one."""
    step, is_knot = find_step(value), np.ones(len(value), bool)
    if len(value) > 2:      # rows that are not on the line between adjacent ones
        rounding = 1e-6    # of the top speed
        is_knot[1:-1] = np.abs(np.diff(value, n=2)) > rounding * np.abs(value).max()
    changes = np.diff(value, prepend=value[:1]) != 0
    knot_share = 0.5    # of the rows that change: an interpolation has fewer knots
    if (is_knot & changes).sum() < knot_share * changes.sum():
        knot_step = find_step(value[is_knot])
        min_ratio = 1.5    # of the step of the knots to that of all rows
        if knot_step and (step is None or knot_step > min_ratio * step):
            return CoarseSpeed(knot_step, t[is_knot], value[is_knot], interpolated=True)
    return CoarseSpeed(step, t, value) if step else None


def find_step(value: Floats) -> float | None:
    """
    Return the step of which all values are multiples, None if there is none.

    Each distinct value other than zero counts once, so that a cruise has the same weight as a
    short passage. The inverse of the step is the lowest frequency at which all have one phase.
    """
    value = np.abs(value[value != 0])
    span = np.ptp(value) if len(value) else 0.0
    if span < MIN_NUMBER:
        return None
    bins, count = np.unique(np.rint((value - value.min()) / span * (VALUE_BINS - 1)).astype(int),
                            return_counts=True)
    min_values = 20    # distinct values needed for a phase
    if len(bins) < min_values:
        distinct = bins * (span / (VALUE_BINS - 1)) + value.min()
        return _step_of_few_values(value, distinct, count)
    if not _may_have_step(bins):
        return None
    coherence = _coherence(bins, FFT_SIZE)
    frequency = np.arange(len(coherence)) * ((VALUE_BINS - 1) / FFT_SIZE / span)
    high = np.flatnonzero((coherence > MIN_COHERENCE) & (frequency > MIN_SPAN_STEPS / span))
    if not len(high):
        return None
    # the first peak: the first run of adjacent frequencies with a high coherence, and its maximum
    last = high[0] + int(np.argmax(np.r_[np.diff(high) > 1, True]))
    peak = high[0] + int(np.argmax(coherence[high[0]:last + 1]))
    step = _refine_step(value, 1 / float(frequency[peak]))
    # values accumulate at the start of a cruise: two or three such speeds always have some step
    min_multiples = 6
    return step if len(np.unique(np.rint(value / step))) >= min_multiples else None


def _coherence(bins: Ints, size: int) -> Floats:
    """Return |mean of exp(2 pi i k bins / size)| for k up to size / 2: (size / 2 + 1,)."""
    occupied = np.zeros(size)
    occupied[bins] = 1.0
    return np.abs(np.fft.rfft(occupied)) / len(bins)


def _may_have_step(bins: Ints) -> bool:
    """
    Return False if the values in these bins have no step: a quick test with a quarter of the size.

    A peak with coherence c, MIN_COHERENCE, is near one of its frequencies, so that phases
    differ by at most pi / 4 to either side: there it is at least (c - sqrt(1 - c^2)) / sqrt(2).
    """
    limit = (MIN_COHERENCE - np.sqrt(1 - MIN_COHERENCE**2)) / np.sqrt(2)
    lowest = int(MIN_SPAN_STEPS * QUICK_FFT_SIZE / VALUE_BINS) - 1
    return bool(_coherence(bins, QUICK_FFT_SIZE)[lowest:].max() >= limit)


def _step_of_few_values(value: Floats, distinct: Floats, count: Ints) -> float | None:
    """Return the step of few distinct values, each of them repeated; count : their rows."""
    min_values, min_repetitions = 4, 5
    if len(distinct) < min_values or np.median(count) < min_repetitions:
        return None
    step = _refine_step(value, float(np.diff(distinct).min()))
    deviation = distinct / step - np.rint(distinct / step)
    max_deviation = 0.02    # in steps
    return step if np.abs(deviation).max() < max_deviation else None


def _refine_step(value: Floats, step: float) -> float:
    """Return the step, near a given one, whose multiples fit the values best."""
    multiple = np.rint(value / step)
    for _ in range(3):
        step = float(multiple @ value / (multiple @ multiple))
        multiple = np.rint(value / step)
    return step


def find_held_speed(t: Floats, value: Floats) -> HeldSpeed | None:
    """Return a held speed from its rows, (n,) s, scale units per s; None if it is not one."""
    change = np.diff(value)
    size = np.abs(change[(value[1:] != 0) & (value[:-1] != 0)])
    changes = size[size > 0]
    if len(changes) < MIN_CHANGES or len(changes) > (1 - MIN_HELD_SHARE) * len(size):
        return None
    step = float(changes.min())
    if step < MIN_SMALLEST_CHANGE * np.percentile(changes, 10):
        return None
    # of each row: the last row with a change, and the direction of this change
    changed_rows = np.where(change != 0, np.arange(1, len(value)), 0)
    last_change = np.maximum.accumulate(changed_rows)
    direction = np.append(0.0, np.sign(change)[np.maximum(last_change - 1, 0)])
    middle = np.where(value == 0, 0.0, value + direction * step / 2)
    return HeldSpeed(step, t, middle, sent=value)
