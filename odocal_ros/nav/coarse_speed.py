# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Speeds in coarse steps: whole km/h of a car's bus, truncated or rounded, at times interpolated.

Such a speed says where it lies in a cell of the grid, so its error is no noise: a cruise stands in
one cell for half a minute. What is sharp is the change: in the step in which the value changes by
one, the speed passes the edge between both cells. Where it changes by more, each value is one of a
cell. Zero is no cell: below it is whatever the sender holds for rest.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.nav.statistics import MISSING_INTERVALS

LEAST_CROSSING = 0.02      # judgement: of a cell, minimum sigma of a crossing
LEAST_CELLS = 3.0          # judgement: cells that the values must span
# judgement: |mean of exp(2 pi i u / q)| of distinct values u on a grid of q
GRID_COHERENCE = 0.9
# judgement: of the values' span, and with zeros: frequencies between; those that rule out a grid
GRID_CELLS, GRID_PADDED, GRID_ROUGH = 2**17, 2**20, 2**18


@dataclass(frozen=True, eq=False)
class SpeedInstants:
    """Speeds at instants t, s: ``value`` + side * offset, scale units per s, 1 sigma."""

    t: Floats        # (m,)
    value: Floats    # (m,)
    side: Floats     # (m,) 1 forwards, -1 backwards
    sigma: Floats    # (m,)

    def between(self, begin: float, end: float) -> 'SpeedInstants':
        """Return those of a time, s."""
        pick = (self.t >= begin) & (self.t <= end)
        return SpeedInstants(self.t[pick], self.value[pick], self.side[pick], self.sigma[pick])


@dataclass(frozen=True, eq=False)
class CoarseSpeed:
    """
    A speed on a grid.

    step : scale units per s.   t, value : (n,) s and scale units per s, the rows that are data.
    interpolated : rows between these were sent, which say nothing more.
    """

    step: float
    t: Floats
    value: Floats
    interpolated: bool = False

    @property
    def truncation(self) -> float:
        """Return the possible truncation of all values: half a step."""
        return self.step / 2

    def mirrored(self, sign: Floats) -> 'CoarseSpeed':
        """Return the speed times signs (n,)."""
        return replace(self, value=self.value * sign)

    @cached_property
    def most(self) -> float:
        """Return the maximum deviation of a speed from the line between rows, with bends."""
        change = np.abs(np.diff(self.value))
        return self.step + (float(np.percentile(change, 95)) / 4 if len(change) else 0.0)

    def way_variance(self, t: Floats) -> Floats:
        """
        Return the variance of travel between n times, s, by rounding: (n - 1,) scale units^2.

        A run of one value has one error, uniform in its cell, which a cruise does not average: as
        much white noise as adds up to the same over the run.
        """
        first = np.flatnonzero(np.diff(self.value, prepend=np.nan))
        begin = self.t[first]
        lasts = np.diff(begin, append=self.t[-1])
        power = self.step**2 / 12 * lasts * (self.value[first] != 0)
        total = np.interp(t, np.append(begin, self.t[-1]),
                          np.append(0.0, np.cumsum(power * lasts)))
        return np.diff(total)

    @cached_property
    def instants(self) -> SpeedInstants:
        """
        Return the speeds that the rows determine, but for the offset that all values share.

        The offset is half a cell where the sender truncates, none where it rounds. A change by one
        cell: the speed of its middle is the mean of both values, uniform by what the speed changes
        in the step. A value between changes by more, or in steps so long that the speed changes by
        more than a cell: it is uniform in its cell, and its rows, however many, count as one.
        """
        q, t, v = self.step, self.t, self.value
        cell = np.rint(v / q)
        at = np.flatnonzero(np.diff(cell))              # changes from row at to the row after it
        jump, h = np.abs(np.diff(cell)[at]), np.diff(t)[at]
        middle, edge = (t[at] + t[at + 1]) / 2, (v[at] + v[at + 1]) / 2
        outer = np.maximum(np.abs(cell[at]), np.abs(cell[at + 1]))
        inner = np.minimum(np.abs(cell[at]), np.abs(cell[at + 1]))
        usual = np.median(np.diff(t)) if len(t) > 1 else 0.0
        gained = _rates(middle, edge, q) * h
        jump = np.where(gained > q, 2, jump)    # there a step may pass two edges, or none
        least_cell = 2    # cells from zero: in the first, a dead band may be at work
        single = (jump == 1) & (outer >= least_cell) & (inner > 0)
        if not self.interpolated:
            single &= h <= MISSING_INTERVALS * usual
        sigma = gained[single]
        run = (jump[:-1] > 1) & (jump[1:] > 1) & (np.abs(cell[at[1:]]) >= least_cell)
        first, length = at[:-1][run] + 1, np.diff(at)[run]
        golden = 0.618034    # steps through a range evenly
        # one of its rows by turns: where the speed turns about, the middle one is the fastest
        row = first + (length * (np.arange(len(first)) * golden % 1.0)).astype(int)
        when, value = np.r_[middle[single], t[row]], np.r_[edge[single], v[row]]
        sigma = np.hypot(np.r_[sigma, np.full(len(row), q)] / np.sqrt(12), LEAST_CROSSING * q)
        order = np.argsort(when, kind='stable')
        return SpeedInstants(when[order], value[order], np.sign(value[order]), sigma[order])


def _rates(t: Floats, edge: Floats, q: float) -> Floats:
    """
    Return the limit of the speed change at its crossings (m,): the faster of both sides.

    As fast as three quarters of the drive's do at least: a small step between two cruises is made
    as quickly as a large one, though no other edge is near to show it; and by its own neighbours
    alone a crossing weighs the more, the later it falls in its step, which is its error.
    """
    if len(t) < 2:
        return np.full(len(t), np.inf)      # one change alone shows no rate
    side = np.maximum(np.abs(np.diff(edge)), q) / np.diff(t)
    rate = np.maximum(np.r_[0.0, side], np.r_[side, 0.0])
    floored: Floats = np.maximum(rate, np.percentile(rate, 75))
    return floored


def coarse_speed(t: Floats, value: Floats) -> CoarseSpeed | None:
    """Return a speed's grid, scale units per s, by its rows; None where it has none."""
    step = grid(value)
    top = np.abs(value).max(initial=0.0)
    knots = np.ones(len(value), bool)
    if len(value) > 2:
        collinear_of_top = 1e-6    # of the top speed: a second difference that vanishes
        knots[1:-1] = np.abs(np.diff(value, n=2)) > collinear_of_top * top
    changes = np.diff(value, prepend=value[:1]) != 0
    knot_share = 0.5    # share of the rows that change: more are no knots of an interpolation
    if (knots & changes).sum() < knot_share * changes.sum():
        own = grid(value[knots])
        knot_step = 1.5    # the knots' grid over that of all rows, at least, of an interpolation
        if own and own > knot_step * (step or 0.0):
            return CoarseSpeed(own, t[knots], value[knots], True)
    return CoarseSpeed(step, t, value) if step else None


def grid(value: Floats) -> float | None:
    """
    Return the step of the grid that values other than zero lie on, None where they lie on none.

    Each distinct value counts once, so that a cruise says no more than a passage; the grid is the
    lowest frequency at which all have one phase.
    """
    value = np.abs(value[value != 0])
    span = np.ptp(value) if len(value) else 0.0
    if span <= 0:
        return None
    u, count = np.unique(np.rint((value - value.min()) / span * (GRID_CELLS - 1)).astype(int),
                         return_counts=True)
    fewest_values = 20    # distinct values to know a grid by
    if len(u) < fewest_values:
        return _of_few(value, u * (span / (GRID_CELLS - 1)) + value.min(), count)
    if not _may_be_grid(u):
        return None
    phase = _coherence(u, GRID_PADDED)
    f = np.arange(len(phase)) * ((GRID_CELLS - 1) / GRID_PADDED / span)
    high = np.flatnonzero((phase > GRID_COHERENCE) & (f > LEAST_CELLS / span))
    if not len(high):
        return None
    last = high[0] + int(np.argmax(np.r_[np.diff(high) > 1, True]))      # of the first peak
    peak = high[0] + int(np.argmax(phase[high[0]:last + 1]))
    step = _refined(value, 1 / float(f[peak]))
    fewest_cells = 6    # cells that they must lie in
    # where a speed bends into a cruise values crowd: at two or three speeds, on some grid
    return step if len(np.unique(np.rint(value / step))) >= fewest_cells else None


def _coherence(u: Ints, size: int) -> Floats:
    """Return |mean of exp(2 pi i k u / size)| of cells u, (size / 2 + 1,) by k."""
    there = np.zeros(size)
    there[u] = 1.0
    phase: Floats = np.abs(np.fft.rfft(there)) / len(u)
    return phase


def _may_be_grid(u: Ints) -> bool:
    """
    Return True if distinct cells u can contain a grid: a quick test of a tenth of them.

    One of GRID_COHERENCE c is within half a step of these frequencies, so at most pi / 4 either
    side of it in phase: there (c - sqrt(1 - c^2)) / sqrt(2) is left of it at least.
    """
    left = (GRID_COHERENCE - np.sqrt(1 - GRID_COHERENCE**2)) / np.sqrt(2)
    fewest = int(LEAST_CELLS * GRID_ROUGH / GRID_CELLS) - 1
    return bool(_coherence(u, GRID_ROUGH)[fewest:].max() >= left)


def _of_few(value: Floats, u: Floats, count: Ints) -> float | None:
    """Return the step of few distinct values u, each sent time and again, that it divides."""
    few_values, often_sent = 4, 5    # distinct, times that each is sent
    if len(u) < few_values or np.median(count) < often_sent:
        return None
    step = _refined(value, float(np.diff(u).min()))
    off = u / step - np.rint(u / step)
    divides_cell = 0.02    # of a cell, by which values may be off its grid
    return step if np.abs(off).max() < divides_cell else None


def _refined(value: Floats, step: float) -> float:
    """Return the step with which values lie on its multiples best, about one that is near."""
    cell = np.rint(value / step)
    for _ in range(3):
        step = float(cell @ value / (cell @ cell))
        cell = np.rint(value / step)
    return step
