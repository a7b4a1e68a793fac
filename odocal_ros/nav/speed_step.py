# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of speeds that are published in steps, and the size of the step.

The values of a quantised speed are multiples of its step, or lie on straight lines between such
multiples if the sender interpolates. A held speed repeats a value until it has changed by a step.
``coarse_speed.py`` describes both.
"""

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.nav.coarse_speed import CoarseSpeed, HeldSpeed

MIN_SPAN_STEPS = 3.0          # judgement: steps that the values must span
MIN_COHERENCE = 0.9     # judgement: of the distinct values at the frequency 1 / step, 1: multiples
# judgement: bins of the values' span; FFT size with zero padding; FFT size of the quick test
VALUE_BINS, FFT_SIZE, QUICK_FFT_SIZE = 2**17, 2**20, 2**18
MIN_NUMBER = 1e-300      # format: floats below it are integers of a wrong type; 1 / x overflows
MIN_HELD_SHARE = 0.3    # judgement: share of moving rows that repeat the one before
# statistical: changes needed to estimate a step; least ratio of the smallest one to their tenth
# percentile. If changes have any size, the smallest of 50 is a fifth of it; if speeds are held,
# both are one step plus the change in one row
MIN_CHANGES, MIN_SMALLEST_CHANGE = 50, 0.6


def find_coarse_speed(t: Floats, value: Floats) -> CoarseSpeed | None:
    """Return a quantised speed from its rows, (n,) s, scale units per s; None if it is not one."""
    step = find_step(value)
    top = np.abs(value).max(initial=0.0)
    knots = np.ones(len(value), bool)       # rows that are not on the line between adjacent ones
    if len(value) > 2:
        zero_of_top = 1e-6    # of the top speed: limit of a second difference of zero
        knots[1:-1] = np.abs(np.diff(value, n=2)) > zero_of_top * top
    changes = np.diff(value, prepend=value[:1]) != 0
    knot_share = 0.5    # of the rows that change: an interpolation has fewer knots
    if (knots & changes).sum() < knot_share * changes.sum():
        knot_step = find_step(value[knots])
        min_ratio = 1.5    # of the step of the knots to that of all rows
        if knot_step and knot_step > min_ratio * (step or 0.0):
            return CoarseSpeed(knot_step, t[knots], value[knots], interpolated=True)
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
    last = high[0] + int(np.argmax(np.r_[np.diff(high) > 1, True]))      # of the first peak
    peak = high[0] + int(np.argmax(coherence[high[0]:last + 1]))
    step = _refine_step(value, 1 / float(frequency[peak]))
    min_multiples = 6
    # values accumulate at the begin of a cruise: two or three such speeds always have some step
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
    few_values, often_sent = 4, 5    # least number of distinct values, and of repetitions
    if len(distinct) < few_values or np.median(count) < often_sent:
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
    changed_rows = np.where(change != 0, np.arange(1, len(value)), 0)
    last_change = np.maximum.accumulate(changed_rows)
    direction = np.append(0.0, np.sign(change)[np.maximum(last_change - 1, 0)])
    middle = np.where(value == 0, 0.0, value + direction * step / 2)
    return HeldSpeed(step, t, middle, sent=value)
