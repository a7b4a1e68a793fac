# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Odometer rows with false values: false counts, frozen counters, lost increments.

False rows are dropped if the counter continues normally after them; unknown travel (a reset, a gap
of speeds or increments) is an uncertainty in the error budget.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, Ints, running_sum, Values
from odocal_ros.data.samples import OdometerForm, OdometerSamples, take
from odocal_ros.nav.odometer import MIN_STEPS, RESET_FACTOR, Travel, without_rollover
from odocal_ros.nav.time_series import MISSING_INTERVALS
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.glitches import is_impossible, speed_glitches

ADJACENT_STEPS = 5    # judgement: steps next to a jump or gap that give the speed there
# counts, rad, m: smaller travel is not reported
STILL_TRAVEL = {'m/pulse': 2.0, 'm/rad': 0.02, '1': 0.02}


def without_false_rows(samples: OdometerSamples, t: Floats, form: OdometerForm,
                       reasons: list[Reason], name: str) -> tuple[OdometerSamples, Floats]:
    """
    Return rows and times, s, without false or repeated counts; false increments are interpolated.

    name : of the odometer, for the reasons, which are added to ``reasons``.
    """
    if form.quantity == 'cumulative':
        false = false_counts(t, samples.value, form.modulus)
        if false.any():
            reasons.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(false.sum())} of {len(t)} {name} '
                                  'counts are frozen or isolated outliers, first at t = '
                                  f'{t[np.argmax(false)]:.2f} s; dropped'))
        samples, t = take(samples, ~false), t[~false]
        held = held_counts(samples.value, form.modulus)
        return take(samples, ~held), t[~held]
    if form.quantity == 'increment':
        false = speed_glitches(t, samples.value.astype(float))
        if false.any():
            good = np.interp(t, t[~false], samples.value[~false].astype(float))
            kept: NDArray[Any] = np.where(false, good, samples.value).astype(samples.value.dtype)
            samples = replace(samples, value=kept)
            reasons.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(false.sum())} of {len(t)} {name} '
                                  'increments are isolated outliers, first at t = '
                                  f'{t[np.argmax(false)]:.2f} s; replaced by interpolation'))
    return samples, t


def counter_steps(value: Values, modulus: int) -> Floats:
    """Return the steps of a counter, rollovers corrected, as floats: (n,) to (n - 1,)."""
    return without_rollover(np.diff(value), modulus).astype(float)


def false_counts(t: Floats, value: Values, modulus: int) -> Bools:
    """
    Return a mask of false counter rows, (n,).

    A counter that is frozen continues with a jump, as if it had counted; an isolated false value
    is a jump and a jump back.
    """
    false = np.zeros(len(t), bool)
    step = counter_steps(value, modulus)
    if len(step) < MIN_STEPS or not step.any():
        return false
    dt = np.diff(t)
    rate = step / np.maximum(dt, np.median(dt))
    size = np.abs(rate)
    top = float(np.percentile(size[size > 0], 95))
    jumps = np.flatnonzero(size > max(RESET_FACTOR * top, 3 / np.median(dt))).tolist()
    max_jumps = 200    # with more the counter is not corrected; the check decides
    if len(jumps) > max_jumps:
        return false
    last_false = -1
    longest_excursion = 30.0    # s between a jump and the jump back
    for j in jumps:
        if j <= last_false:
            continue
        stall = _stall_begin(step, j)
        returns = [k for k in jumps if k > j and t[k + 1] - t[j] <= longest_excursion]
        # candidates, first and last step: frozen before the jump, or the jump and back
        for a, b in [(stall, j)] * int(stall < j) + [(j, k) for k in returns]:
            travel = counter_steps(value[[a, b + 1]], modulus)[0]  # exact, unlike a sum of steps
            possible = 1.2 * top * (t[b + 1] - t[a]) + 3      # travel in this time
            is_excursion = a == j and abs(travel) <= possible and (
                min(abs(step[a]), abs(step[b])) > 2 * possible)
            if is_excursion or _continues(t, travel, rate, a, b):
                false[a + 1:b + 1] = True
                last_false = b
                break
    return false


def held_counts(value: Values, modulus: int) -> Bools:
    """
    Return a mask of counter rows that repeat a value until the next update.

    A counter that is published faster than it is read repeats each value, and its travel is known
    at the updates only. Rows of a standstill are kept at the mean interval of updates, counted
    back from the next one.
    """
    size = np.abs(counter_steps(value, modulus))
    update = np.flatnonzero(size) + 1
    interval_rows = np.diff(update)
    # an update of several counts after rows without one: judgement, fewer are rounding
    min_counts = 3.0
    if len(update) < MIN_STEPS or np.median(interval_rows) < 2 or (
            np.median(size[update - 1]) < min_counts * size[update - 1].min()):
        return np.zeros(len(value), bool)
    moving = interval_rows < 2 * np.median(interval_rows)
    row = np.arange(len(value))
    k = np.searchsorted(update, row)      # the next update
    # number of mean intervals to the next update: one row of each is kept
    number = np.floor((np.append(update, row[-1])[k] - row) / np.mean(interval_rows[moving]))
    number[np.r_[False, moving, False][k]] = 0.0
    held: Bools = np.append(False, size == 0) & np.append(number[1:] == number[:-1], False)
    return held


def _continues(t: Floats, travel: float, rate: Floats, a: int, b: int) -> bool:
    """Return True if the travel from step a to after step b agrees with adjacent speeds."""
    duration = t[b + 1] - t[a]
    expected = [_median_or_zero(x) * duration for x in _adjacent(rate, a, b)]
    largest_share = 0.5    # judgement: largest difference, of the expected travel
    tolerance = largest_share * max(abs(x) for x in expected) + 3      # counts
    return bool(min(expected) - tolerance <= travel <= max(expected) + tolerance)


def _adjacent(rate: Floats, a: int, b: int) -> tuple[Floats, Floats]:
    """Return the rates of the steps next to the steps a to b: before, and after."""
    return rate[max(0, a - ADJACENT_STEPS):a], rate[b + 1:b + 1 + ADJACENT_STEPS]


def with_gap_uncertainty(travel: Travel, value: Values,
                         form: OdometerForm) -> tuple[Travel, Floats, Floats]:
    """
    Return travel with interpolated gaps, and times (s) and sigmas of uncertain travel.

    A counter has travel across gaps, but not across resets, which ``travel`` has corrected.
    """
    none = np.empty(0)
    if len(travel.t) < MIN_STEPS:
        return travel, none, none
    dt, step = np.diff(travel.t), np.diff(travel.s)
    usual = np.median(dt)
    rate = step / np.maximum(dt, usual)
    if form.quantity == 'cumulative':
        return travel, *_reset_uncertainty(travel, step, rate, counter_steps(value, form.modulus))
    gaps = np.flatnonzero(dt > max(MISSING_INTERVALS * usual, 0.2))
    before, after = np.array([[_median_or_zero(x) for x in _adjacent(rate, k, k)]
                              for k in gaps.tolist()]).reshape(-1, 2).T
    missing = dt[gaps] - (usual if form.quantity == 'increment' else 0.0)
    if form.quantity == 'increment' and len(gaps):
        step = step.copy()
        step[gaps] += (before + after) / 2 * missing
        travel = Travel(travel.t, running_sum(step), travel.quantum)
    # speed within a gap: uniform between the adjacent ones, and uniform within 2 % of these for
    # each second of the gap, at most 30 %
    speed_sigma = np.abs(after - before) / np.sqrt(12) + np.minimum(
        missing / 50, 0.3) * np.maximum(np.abs(before), np.abs(after)) / np.sqrt(3)
    times, sigma = travel.t[gaps], speed_sigma * missing
    if form.quantity == 'rate':
        hidden = np.copysign(_travel_below_threshold(travel, value), step)
        rows = np.flatnonzero(hidden)
        travel = replace(travel, s=travel.s + running_sum(hidden))
        times, sigma = np.r_[times, travel.t[rows]], np.r_[sigma, np.abs(hidden[rows]) / 2]
    return travel, times, sigma


def _reset_uncertainty(travel: Travel, step: Floats, rate: Floats,
                       counts: Floats) -> tuple[Floats, Floats]:
    """Return times, s, of resets of a counter and sigmas of the travel that is lost there."""
    resets = np.flatnonzero(np.abs(np.abs(step) - np.abs(counts)) > 1e-6 * np.abs(counts) + 1e-9)
    # only the adjacent speeds bound the travel since the last count: uniform up to this limit
    limits = []
    for k in resets.tolist():
        a = _stall_begin(step, k)
        speed = max(abs(_median_or_zero(x)) for x in _adjacent(rate, a, k))
        limits.append(speed * (travel.t[k + 1] - travel.t[a]))
    return travel.t[resets], np.array(limits) / np.sqrt(3)


def _travel_below_threshold(travel: Travel, value: Values) -> Floats:
    """
    Return the travel at speeds published as zero, at stops and starts: (n - 1,).

    It is v^2 / 2a with the smallest published speed v and the acceleration a of adjacent rows.
    """
    hidden, size = np.zeros(len(value) - 1), np.abs(value)
    min_speed = 2 * travel.coarse.step if travel.coarse else 0.0
    # least ratio to the counted travel in a dead band
    dead_band_ratio = 1.5
    for edge in np.flatnonzero((size[1:] == 0) != (size[:-1] == 0)):
        stops = size[edge + 1] == 0
        first, direction = (edge, -1) if stops else (edge + 1, 1)
        rows = first + direction * np.arange(ADJACENT_STEPS)
        rows = rows[(rows >= 0) & (rows < len(size))]
        v, change = size[rows[0]], size[rows[-1]] - size[rows[0]]
        duration = abs(travel.t[rows[-1]] - travel.t[rows[0]])
        if v > min_speed and change > 0 and duration > 0:
            counted = v * (travel.t[edge + 1] - travel.t[edge]) / 2
            total = min(v**2 * duration / (2 * change), v)      # no longer than 2 s
            hidden[edge] = total - counted if total > dead_band_ratio * counted else 0.0
    return hidden


def _stall_begin(step: Floats, j: int) -> int:
    """Return the first of the zero steps directly before step j, or j if there are none."""
    moves = np.flatnonzero(step[:j])
    return int(moves[-1]) + 1 if len(moves) else 0


def _median_or_zero(rate: Floats) -> float:
    return float(np.median(rate)) if len(rate) else 0.0


class StepReader:
    """Conversion of rows to steps, in odometer units; for a leg see ``nav.odometer.travel``."""

    def __init__(self, form: OdometerForm) -> None:
        self.form = form
        self._last: tuple[Ints, Values] | None = None

    @property
    def still(self) -> float:
        """Return the largest apparent travel at rest."""
        return STILL_TRAVEL.get(self.form.scale_unit, 0.02)

    def read(self, block: OdometerSamples) -> tuple[Floats, Ints, Floats]:
        """Return step, stamp, ns, and duration, s, of each possible row since the one before."""
        good = ~is_impossible('value', block.value)
        stamps, values = block.stamp_ns[good], block.value[good]
        if self._last is not None:
            stamps = np.r_[self._last[0], stamps]
            values = np.r_[self._last[1], values]
        self._last = (stamps[-1:], values[-1:])
        seconds = np.diff(stamps) * 1e-9
        if self.form.quantity == 'increment':
            steps = values[1:]
        elif self.form.quantity == 'rate':
            steps = values[1:] * seconds
        else:
            steps = without_rollover(np.diff(values), self.form.modulus)
        return np.asarray(steps, dtype=np.float64), stamps[1:], seconds
