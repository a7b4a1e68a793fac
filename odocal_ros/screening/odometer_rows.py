# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Odometer rows with false values (false counts, frozen counters), and travel that was not measured.

In: rows of one wheel. Out: corrected rows, or travel with the sigma where it is interpolated.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, Ints, running_sum, Values
from odocal_ros.data.samples import OdometerForm, OdometerSamples, take
from odocal_ros.nav.odometer import MIN_STEPS, RESET_FACTOR, Travel, without_rollover
from odocal_ros.nav.time_series import MISSING_INTERVALS
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.glitches import is_impossible, speed_glitches

ADJACENT_STEPS = 5    # judgement: steps next to a jump or gap that give the speed there
# judgement: largest apparent travel at rest, by the unit of the scale factor: counts, rad, m
REST_TRAVEL = {'m/pulse': 2.0, 'm/rad': 0.02, '1': 0.02}


class UncertainTravel(NamedTuple):
    """Times at which travel is uncertain."""

    t: Floats        # (k,) s
    sigma: Floats    # (k,) scale units


CERTAIN = UncertainTravel(np.empty(0), np.empty(0))    # definition: no uncertain travel


def without_false_rows(samples: OdometerSamples, t: Floats, form: OdometerForm,
                       name: str) -> tuple[OdometerSamples, Floats, list[Reason]]:
    """
    Return rows and their times, s, without false or repeated counts, and reasons.

    False increments are interpolated.   name : of the odometer, in the reasons.
    """
    if form.quantity == 'cumulative':
        is_false = false_counts(t, samples.value, form.modulus)
        reasons = _false_row_reasons(is_false, t, f'{name} counts are frozen or isolated '
                                     'outliers', 'dropped')
        samples, t = take(samples, ~is_false), t[~is_false]
        is_new = ~repeated_counts(samples.value, form.modulus)
        return take(samples, is_new), t[is_new], reasons
    value = samples.value
    if form.quantity == 'rate':
        return samples, t, []
    is_false = speed_glitches(t, value.astype(float))
    if is_false.any():
        interpolated = np.interp(t, t[~is_false], value[~is_false].astype(float))
        corrected: NDArray[Any] = np.where(is_false, interpolated, value).astype(value.dtype)
        samples = replace(samples, value=corrected)
    return samples, t, _false_row_reasons(is_false, t, f'{name} increments are isolated outliers',
                                          'replaced by interpolation')


def _false_row_reasons(is_false: Bools, t: Floats, fault: str, action: str) -> list[Reason]:
    return [Reason(Code.BAD_ROWS_DROPPED, f'{int(is_false.sum())} of {len(t)} {fault}, first at t '
                   f'= {t[np.argmax(is_false)]:.2f} s; {action}')] if is_false.any() else []


def counter_steps(value: Values, modulus: int) -> Floats:
    """Return the steps of a counter, rollovers corrected, as floats: (n,) to (n - 1,)."""
    return without_rollover(np.diff(value), modulus).astype(float)


def false_counts(t: Floats, value: Values, modulus: int) -> Bools:
    """
    Return a mask of false counter rows, (n,).

    Rows before a jump are false if the counter was frozen there: its jump is the travel since it
    stopped. Rows between a jump and a jump back are false.
    """
    is_false = np.zeros(len(t), bool)
    step = counter_steps(value, modulus)
    if len(step) < MIN_STEPS or not step.any():
        return is_false
    dt = np.diff(t)
    rate = step / np.maximum(dt, np.median(dt))
    size = np.abs(rate)
    high_rate = float(np.percentile(size[size > 0], 95))
    jumps = np.flatnonzero(size > max(RESET_FACTOR * high_rate, 3 / np.median(dt))).tolist()
    max_jumps = 200    # with more the counter is not corrected; the check decides
    if len(jumps) > max_jumps:
        return is_false
    last_false = -1
    max_duration = 30.0    # s between a jump and the jump back
    for jump in jumps:
        if jump <= last_false:
            continue
        frozen_from = _first_zero_step(step, jump)
        # first and last step of false rows: before the jump, or from it to a jump back
        candidates = [(frozen_from, jump)] * (frozen_from < jump) + [
            (jump, k) for k in jumps if k > jump and t[k + 1] - t[jump] <= max_duration]
        for first, last in candidates:
            travel = counter_steps(value[[first, last + 1]], modulus)[0]    # exact, unlike sums
            max_travel = 1.2 * high_rate * (t[last + 1] - t[first]) + 3      # counts
            jumps_back = first == jump and abs(travel) <= max_travel and (
                min(abs(step[first]), abs(step[last])) > 2 * max_travel)
            if jumps_back or _fits_adjacent_rates(t, travel, rate, first, last):
                is_false[first + 1:last + 1] = True
                last_false = last
                break
    return is_false


def repeated_counts(value: Values, modulus: int) -> Bools:
    """
    Return a mask of counter rows that only repeat a value, (n,).

    A counter that is published faster than it is read repeats each value until its next update,
    and its travel is known at the updates only. At a standstill one row is kept for each mean
    interval of updates, counted back from the next update.
    """
    size = np.abs(counter_steps(value, modulus))
    update = np.flatnonzero(size) + 1      # rows with a new value
    interval_rows = np.diff(update)
    # judgement: rows without counts between updates of only one or two counts are slow motion
    min_counts = 3.0
    if len(update) < MIN_STEPS or np.median(interval_rows) < 2 or (
            np.median(size[update - 1]) < min_counts * size[update - 1].min()):
        return np.zeros(len(value), bool)
    is_moving = interval_rows < 2 * np.median(interval_rows)
    row = np.arange(len(value))
    next_update = np.searchsorted(update, row)
    rows_to_update = np.append(update, row[-1])[next_update] - row
    intervals_to_update = np.floor(rows_to_update / np.mean(interval_rows[is_moving]))
    # in motion a row repeats the value until the next update
    intervals_to_update[np.r_[False, is_moving, False][next_update]] = 0.0
    same_interval = np.append(intervals_to_update[1:] == intervals_to_update[:-1], False)
    return np.asarray(np.append(False, size == 0) & same_interval)


def _fits_adjacent_rates(t: Floats, travel: float, rate: Floats, first: int, last: int) -> bool:
    """Return True if the travel from step ``first`` to ``last`` agrees with adjacent rates."""
    duration = t[last + 1] - t[first]
    expected = [adjacent * duration for adjacent in _adjacent_rates(rate, first, last)]
    max_share = 0.5    # judgement: largest difference, of the expected travel
    tolerance = max_share * max(abs(x) for x in expected) + 3      # counts
    return bool(min(expected) - tolerance <= travel <= max(expected) + tolerance)


def _adjacent_rates(rate: Floats, first: int, last: int) -> tuple[float, float]:
    """Return the median rates before step ``first`` and after ``last``; 0 without steps."""
    sides = rate[max(0, first - ADJACENT_STEPS):first], rate[last + 1:last + 1 + ADJACENT_STEPS]
    before, after = (float(np.median(side)) if len(side) else 0.0 for side in sides)
    return before, after


def with_gap_uncertainty(travel: Travel, value: Values,
                         form: OdometerForm) -> tuple[Travel, UncertainTravel]:
    """
    Return travel with interpolated gaps, and the uncertain travel.

    A counter measures the travel across gaps; it is uncertain only at resets, which ``travel``
    does not include.
    """
    if len(travel.t) < MIN_STEPS:
        return travel, CERTAIN
    dt, step = np.diff(travel.t), np.diff(travel.s)
    usual_dt = np.median(dt)
    rate = step / np.maximum(dt, usual_dt)
    if form.quantity == 'cumulative':
        return travel, _reset_uncertainty(travel, step, rate, counter_steps(value, form.modulus))
    gaps = np.flatnonzero(dt > max(MISSING_INTERVALS * usual_dt, 0.2))
    before, after = np.array([_adjacent_rates(rate, k, k)
                              for k in gaps.tolist()]).reshape(-1, 2).T
    missing_s = dt[gaps] - (usual_dt if form.quantity == 'increment' else 0.0)
    if form.quantity == 'increment' and len(gaps):
        step = step.copy()
        step[gaps] += (before + after) / 2 * missing_s
        travel = Travel(travel.t, running_sum(step), travel.quantum)
    # the mean speed in a gap is uniform between the adjacent ones (sigma: width / sqrt(12)), and
    # then uniform within +- 2 % of them for each second, at most 30 % (half width / sqrt(3)).
    # Judgement
    max_change = np.minimum(missing_s / 50, 0.3) * np.maximum(np.abs(before), np.abs(after))
    speed_sigma = np.abs(after - before) / np.sqrt(12) + max_change / np.sqrt(3)
    times, sigma = travel.t[gaps], speed_sigma * missing_s
    if form.quantity == 'rate':
        unpublished = np.copysign(_travel_below_threshold(travel, value), step)
        rows = np.flatnonzero(unpublished)
        travel = replace(travel, s=travel.s + running_sum(unpublished))
        times = np.r_[times, travel.t[rows]]
        sigma = np.r_[sigma, np.abs(unpublished[rows]) / 2]
    return travel, UncertainTravel(times, sigma)


def _reset_uncertainty(travel: Travel, step: Floats, rate: Floats,
                       counts: Floats) -> UncertainTravel:
    """Return the travel that is lost at resets; counts : (n,) steps of the counter."""
    resets = np.flatnonzero(np.abs(np.abs(step) - np.abs(counts)) > 1e-6 * np.abs(counts) + 1e-9)
    # only the adjacent speeds bound the travel since the last count: uniform up to this limit
    limits = []
    for k in resets.tolist():
        first = _first_zero_step(step, k)
        speed = max(map(abs, _adjacent_rates(rate, first, k)))
        limits.append(speed * (travel.t[k + 1] - travel.t[first]))
    return UncertainTravel(travel.t[resets], np.array(limits) / np.sqrt(3))


def _travel_below_threshold(travel: Travel, value: Values) -> Floats:
    """
    Return the travel at speeds published as zero, at stops and starts, for each step: (n - 1,).

    It is v^2 / 2a with the last speed v before zero, or the first one after it, and the
    acceleration a of adjacent rows.
    """
    hidden, size = np.zeros(len(value) - 1), np.abs(value)
    min_speed = 2 * travel.coarse.step if travel.coarse else 0.0
    min_ratio = 1.5      # to the counted travel: with a smaller one there is no dead band
    for edge in np.flatnonzero((size[1:] == 0) != (size[:-1] == 0)):
        stops = size[edge + 1] == 0
        first, direction = (edge, -1) if stops else (edge + 1, 1)
        rows = first + direction * np.arange(ADJACENT_STEPS)
        rows = rows[(rows >= 0) & (rows < len(size))]
        v, change = size[rows[0]], size[rows[-1]] - size[rows[0]]      # m/s or rad/s
        duration = abs(travel.t[rows[-1]] - travel.t[rows[0]])
        if v > min_speed and change > 0 and duration > 0:
            counted = v * (travel.t[edge + 1] - travel.t[edge]) / 2
            total = min(v**2 * duration / (2 * change), v)      # no longer than 2 s
            hidden[edge] = total - counted if total > min_ratio * counted else 0.0
    return hidden


def _first_zero_step(step: Floats, k: int) -> int:
    """Return the first of the zero steps directly before step k, or k if there are none."""
    moves = np.flatnonzero(step[:k])
    return int(moves[-1]) + 1 if len(moves) else 0


class StepReader:
    """Conversion of blocks of rows, as they arrive, to steps of travel in odometer units."""

    def __init__(self, form: OdometerForm) -> None:
        self.form = form
        self.rest_travel = REST_TRAVEL.get(form.scale_unit, 0.02)
        self._last: tuple[Ints, Values] | None = None      # stamp and value of the last row

    def read(self, block: OdometerSamples) -> tuple[Floats, Ints, Floats]:
        """Return travel, stamp, ns, and duration, s, from each valid row to the next."""
        is_valid = ~is_impossible('value', block.value)
        stamps, values = block.stamp_ns[is_valid], block.value[is_valid]
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
