# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Speeds in coarse steps: whole km/h of a car's bus, truncated or rounded, sometimes interpolated.

Such values are on a grid of steps. A value only determines the cell, one step wide, that contains
the speed, and its error is not noise: a cruise stays in one cell for half a minute. Changes are
accurate: when the value changes by one step, the speed passes the edge between two cells. When it
changes by more, each value only determines its cell. Zero is not a cell: it includes all speeds
that the sender treats as rest.

Other speeds are held, repeated until they have changed by a step, as on many buses. The value
after a change is correct. Until the next change the speed is within one step of it, in the
direction of the change: half a step is added, and the error is uniform over the step, not noise.
Zeros are used unchanged: at standstill the vehicle does not move.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, running_sum
from odocal_ros.nav.time_series import MISSING_INTERVALS

MIN_CROSSING = 0.02      # judgement: in cells, minimum sigma of a speed at an edge
MIN_SPAN_CELLS = 3.0          # judgement: cells that the values must span
# judgement: |mean of exp(2 pi i u / q)| of distinct values u on a grid of q
GRID_COHERENCE = 0.9
# judgement: cells of the values' span; FFT size with zero padding; FFT size of the quick test
GRID_CELLS, GRID_PADDED, GRID_ROUGH = 2**17, 2**20, 2**18
MIN_NUMBER = 1e-300      # format: floats below it are integers of a wrong type; 1 / x overflows
# judgement: minimum share of moving rows that repeat the one before
HELD_SHARE = 0.3
# statistical: changes needed to estimate a step; least ratio of the smallest one to their tenth
# percentile. If changes have any size, the smallest of 50 is a fifth of it; if speeds are held,
# both are one step plus the change in one row
MIN_CHANGES, MIN_SMALLEST_CHANGE = 50, 0.6


@dataclass(frozen=True, eq=False)
class SpeedInstants:
    """Speeds at m instants: value + side * offset, with an unknown offset common to all."""

    t: Floats        # (m,) s
    value: Floats    # (m,) scale units per s
    side: Floats     # (m,) 1 forwards, -1 backwards
    sigma: Floats    # (m,) scale units per s

    def between(self, begin: float, end: float) -> 'SpeedInstants':
        """Return the instants between two times, s."""
        inside = (self.t >= begin) & (self.t <= end)
        return SpeedInstants(*(x[inside] for x in (self.t, self.value, self.side, self.sigma)))


@dataclass(frozen=True, eq=False)
class CoarseSpeed:
    """A speed on a grid: rows with information, (n,)."""

    step: float      # scale units per s
    t: Floats        # s
    value: Floats    # scale units per s
    interpolated: bool = False    # the sender also publishes interpolated rows between these

    @property
    def truncation(self) -> float:
        """Return the possible common error of all values by truncation: half a step."""
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
        Return the variance of travel between n times, s, by rounding: (n - 1,) scale units^2.

        A run of equal values has one error, uniform in its cell, that does not average out. It is
        replaced by white noise with the same variance over the run.
        """
        first = np.flatnonzero(np.diff(self.value, prepend=np.nan))
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

        The offset is half a cell if the sender truncates, zero if it rounds. A change by one cell
        gives the speed at its middle: the mean of both values, with an error uniform over the
        speed change in the step. The error of a value between larger changes, or in steps so long
        that the speed changes by more than a cell, is uniform in its cell; its rows count as one.
        """
        q, t, v = self.step, self.t, self.value
        cell = np.rint(v / q)
        at = np.flatnonzero(np.diff(cell))              # changes from row at to the row after it
        jump, h = np.abs(np.diff(cell)[at]), np.diff(t)[at]
        middle, edge = (t[at] + t[at + 1]) / 2, (v[at] + v[at + 1]) / 2
        outer = np.maximum(np.abs(cell[at]), np.abs(cell[at + 1]))
        inner = np.minimum(np.abs(cell[at]), np.abs(cell[at + 1]))
        usual = np.median(np.diff(t)) if len(t) > 1 else 0.0
        speed_change = _rate_limits(middle, edge, q) * h
        jump = np.where(speed_change > q, 2, jump)    # there a step may pass two edges, or none
        min_cell = 2    # cells from zero: the first may have a dead band
        single = (jump == 1) & (outer >= min_cell) & (inner > 0)
        if not self.interpolated:
            single &= h <= MISSING_INTERVALS * usual
        run = (jump[:-1] > 1) & (jump[1:] > 1) & (np.abs(cell[at[1:]]) >= min_cell)
        first, length = at[:-1][run] + 1, np.diff(at)[run]
        # one row of each run, at varying places: the middle one of a run at an extremum of the
        # speed would be the fastest. Multiples of the golden ratio are evenly distributed
        golden = 0.618034
        row = first + (length * (np.arange(len(first)) * golden % 1.0)).astype(int)
        when, value = np.r_[middle[single], t[row]], np.r_[edge[single], v[row]]
        width = np.r_[speed_change[single], np.full(len(row), q)]
        sigma = np.hypot(width / np.sqrt(12), MIN_CROSSING * q)
        order = np.argsort(when, kind='stable')
        return SpeedInstants(when[order], value[order], np.sign(value[order]), sigma[order])


def _rate_limits(t: Floats, edge: Floats, q: float) -> Floats:
    """
    Return an upper limit of the rate of change at each crossing, (m,): the larger of both sides.

    It is at least the upper quartile of the drive: a small step between two cruises is as fast as
    a large one, but has no other edge nearby. With a rate by its neighbours alone, the weight of a
    crossing would depend on its error.
    """
    if len(t) < 2:
        return np.full(len(t), np.inf)      # a single change gives no rate
    side = np.maximum(np.abs(np.diff(edge)), q) / np.diff(t)
    rate = np.maximum(np.r_[0.0, side], np.r_[side, 0.0])
    floored: Floats = np.maximum(rate, np.percentile(rate, 75))
    return floored


def find_coarse_speed(t: Floats, value: Floats) -> CoarseSpeed | None:
    """Return the grid of a speed from its rows, (n,) s and scale units per s; None without one."""
    step = find_grid_step(value)
    top = np.abs(value).max(initial=0.0)
    knots = np.ones(len(value), bool)
    if len(value) > 2:
        collinear_of_top = 1e-6    # of the top speed: limit of a second difference of zero
        knots[1:-1] = np.abs(np.diff(value, n=2)) > collinear_of_top * top
    changes = np.diff(value, prepend=value[:1]) != 0
    knot_share = 0.5    # of the rows that change: an interpolation has fewer knots
    if (knots & changes).sum() < knot_share * changes.sum():
        knot_grid = find_grid_step(value[knots])
        knot_step = 1.5    # least ratio of the knots' grid to that of all rows
        if knot_grid and knot_grid > knot_step * (step or 0.0):
            return CoarseSpeed(knot_grid, t[knots], value[knots], True)
    return CoarseSpeed(step, t, value) if step else None


def find_grid_step(value: Floats) -> float | None:
    """
    Return the step of the grid of all values other than zero, None if they are not on a grid.

    Each distinct value counts once, so that a cruise has the same weight as a short passage. The
    grid is the lowest frequency at which all values have the same phase.
    """
    value = np.abs(value[value != 0])
    span = np.ptp(value) if len(value) else 0.0
    if span < MIN_NUMBER:
        return None
    u, count = np.unique(np.rint((value - value.min()) / span * (GRID_CELLS - 1)).astype(int),
                         return_counts=True)
    min_values = 20    # distinct values needed to detect a grid
    if len(u) < min_values:
        return _step_of_few_values(value, u * (span / (GRID_CELLS - 1)) + value.min(), count)
    if not _may_be_grid(u):
        return None
    phase = _coherence(u, GRID_PADDED)
    f = np.arange(len(phase)) * ((GRID_CELLS - 1) / GRID_PADDED / span)
    high = np.flatnonzero((phase > GRID_COHERENCE) & (f > MIN_SPAN_CELLS / span))
    if not len(high):
        return None
    last = high[0] + int(np.argmax(np.r_[np.diff(high) > 1, True]))      # of the first peak
    peak = high[0] + int(np.argmax(phase[high[0]:last + 1]))
    step = _refine_step(value, 1 / float(f[peak]))
    min_cells = 6    # cells with values
    # values accumulate at the begin of a cruise: two or three such speeds are on some grid
    return step if len(np.unique(np.rint(value / step))) >= min_cells else None


def _coherence(u: Ints, size: int) -> Floats:
    """Return |mean of exp(2 pi i k u / size)| of cells u, (size / 2 + 1,) by k."""
    occupied = np.zeros(size)
    occupied[u] = 1.0
    return np.abs(np.fft.rfft(occupied)) / len(u)


def _may_be_grid(u: Ints) -> bool:
    """
    Return True if distinct cells u can contain a grid: a quick test of a quarter of frequencies.

    A peak with coherence c, GRID_COHERENCE, is within half a step of one of them, so that phases
    differ by at most pi / 4 to either side: there it is at least (c - sqrt(1 - c^2)) / sqrt(2).
    """
    limit = (GRID_COHERENCE - np.sqrt(1 - GRID_COHERENCE**2)) / np.sqrt(2)
    lowest = int(MIN_SPAN_CELLS * GRID_ROUGH / GRID_CELLS) - 1
    return bool(_coherence(u, GRID_ROUGH)[lowest:].max() >= limit)


def _step_of_few_values(value: Floats, u: Floats, count: Ints) -> float | None:
    """Return the step that divides few distinct values u, each repeated many times."""
    few_values, often_sent = 4, 5    # least number of distinct values, and of repetitions
    if len(u) < few_values or np.median(count) < often_sent:
        return None
    step = _refine_step(value, float(np.diff(u).min()))
    deviation = u / step - np.rint(u / step)
    largest = 0.02    # of a cell
    return step if np.abs(deviation).max() < largest else None


def _refine_step(value: Floats, step: float) -> float:
    """Return the step, near a given one, whose multiples fit the values best."""
    cell = np.rint(value / step)
    for _ in range(3):
        step = float(cell @ value / (cell @ cell))
        cell = np.rint(value / step)
    return step


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldSpeed(CoarseSpeed):
    """A speed held until it has changed by ``step``; ``value`` is the middle of its interval."""

    sent: Floats             # (n,) as published

    @property
    def truncation(self) -> float:
        """Return the common error of all values by truncation: 0."""
        return 0.0

    def mirrored(self, sign: Floats) -> 'HeldSpeed':
        """Return the speed times signs (n,)."""
        return replace(self, value=self.value * sign, sent=self.sent * sign)

    @cached_property
    def instants(self) -> SpeedInstants:
        """Return the speeds at changes, which are correct except for sampling."""
        v = self.sent
        row = np.flatnonzero((np.diff(v, prepend=v[:1]) != 0) & (v != 0))
        sigma = np.full(len(row), MIN_CROSSING * self.step)
        return SpeedInstants(self.t[row], v[row], np.sign(v[row]), sigma)


def find_held_speed(t: Floats, value: Floats) -> HeldSpeed | None:
    """Return the held speed from rows (n,); None if the speed is not held."""
    change = np.diff(value)
    size = np.abs(change[(value[1:] != 0) & (value[:-1] != 0)])
    changes = size[size > 0]
    if len(changes) < MIN_CHANGES or len(changes) > (1 - HELD_SHARE) * len(size):
        return None
    step = float(changes.min())
    if step < MIN_SMALLEST_CHANGE * np.percentile(changes, 10):
        return None
    last = np.maximum.accumulate(np.where(change != 0, np.arange(1, len(value)), 0))
    side = np.append(0.0, np.sign(change)[np.maximum(last - 1, 0)])
    middle = np.where(value == 0, 0.0, value + side * step / 2)
    return HeldSpeed(step, t, middle, sent=value)
