# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Wheel counters that roll over below the range of their message type, each separately.

Two wheels of two drivers can count differently: one sends 64 bits, the other 16 in a message of
64. Such a rollover leaves jumps against the travel, all of one size: the span.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, Ints, Values
from odocal_ros.data.samples import OdometerSamples
from odocal_ros.nav.odometer import FEWEST_STEPS
from odocal_ros.reasons import Code, Reason

SPANS = {'whole': 2.0 ** np.arange(6, 54), 'angle': np.array([2 * np.pi, 4 * np.pi, 360.0])}
NAMED_SPANS = {float(2 * np.pi): '2 pi', float(4 * np.pi): '4 pi'}


@dataclass(frozen=True, eq=False)
class Span:
    """Where a counter rolls over: its span in counts, exact or not, and the rows before."""

    size: float
    sigma: float                 # 0: certain
    rows: NDArray[np.int64]      # (k,)
    turns: NDArray[np.int64]     # (k,) +1 rolled over upwards, -1 downwards


def hidden_span(value: Values, step: Floats) -> Span | None:
    """
    Return the span of a counter whose rollovers are not undone yet, None where it has none.

    value : (n,) as sent.   step : (n - 1,) its steps, known rollovers undone.
    """
    if len(step) < FEWEST_STEPS or not step.any():
        return None
    usual = _running_median(step)
    whole = np.issubdtype(value.dtype, np.integer)
    off = step - usual
    top = float(np.percentile(np.abs(usual), 99.9))
    least_jump = 8.0    # counts, smallest jump against the travel
    far = np.abs(off) > np.maximum(2 * np.abs(usual) + least_jump * whole, 1.5 * top)
    rows = np.flatnonzero(far & (off * usual <= 0))      # a frozen counter catches up forwards
    if not len(rows):
        return None
    size = np.abs(off[rows])
    slack = np.abs(usual[rows]) / 2 + (3.0 if whole else 1e-3 * size)
    spans = SPANS['whole' if whole else 'angle']
    middle = float(np.median(size))
    known = float(spans[np.argmin(np.abs(spans - middle))])
    typical = float(np.median(slack))
    sigma = 0.0
    fewest_jumps = 3    # jumps of one size that make a span which is no power of two
    power_slack = 0.01    # of the span, slack up to which one jump makes a power of two
    if abs(known - middle) <= typical and (len(rows) > 1 or slack[0] < power_slack * known):
        span = known
    elif len(rows) >= fewest_jumps:
        span, sigma = _measured(value, rows, middle, typical) if whole else (
            middle, typical / np.sqrt(3 * len(rows)))
    else:
        return None
    agree = np.abs(size - span) <= 2 * slack
    same_span_share = 0.8    # share of the jumps that must agree
    if agree.mean() < same_span_share:
        return None
    rows = rows[agree]
    return Span(span, sigma, rows, -np.sign(off[rows]).astype(np.int64))


def _running_median(step: Floats) -> Floats:
    median_reach = 7    # steps on each side of the running median for the step replaced by a jump
    padded = np.pad(step, median_reach, mode='edge')
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * median_reach + 1)
    return np.median(windows, axis=-1)


def _measured(value: Values, rows: Ints, middle: float, slack: float) -> tuple[float, float]:
    """Return a span that is no power of two, and its sigma: the roundest number that fits."""
    ends = np.stack([value[rows], value[rows + 1]]).astype(float)
    low = ends.max() - ends.min() + 1              # the counter was seen to take so many values
    high = max(low, middle + 2 * slack / np.sqrt(len(rows)))
    for unit in (1e6, 1e5, 1e4, 1e3, 1e2):
        span = np.ceil(low / unit) * unit
        if span <= high:
            return float(span), 0.0
    return float(round((low + high) / 2)), max(1.0, (high - low) / np.sqrt(12))


def unrolled(t: Floats, samples: OdometerSamples, step: Floats,
             side: str) -> tuple[OdometerSamples, tuple[Reason, ...], Floats, Floats]:
    """
    Return rows with hidden rollovers corrected, the reasons, and the remaining uncertainty.

    t, samples : (n,) s, and usable rows of a running count.   step : (n - 1,) its
    steps, rollovers of the type's span undone.   side : whose counter it is, for people.

    Returns
    -------
    samples; reasons; (k,) s and (k,) counts: times and sigmas of uncertain travel.

    """
    span = hidden_span(samples.value, step)
    none = np.empty(0)
    if span is None:
        return samples, (), none, none
    turns = np.zeros(len(t), np.int64)
    turns[span.rows + 1] = span.turns
    size = round(span.size) if np.issubdtype(samples.value.dtype, np.integer) else span.size
    value: NDArray[Any] = samples.value + size * np.cumsum(turns)
    times = len(span.rows)
    about = f'about {span.size:.6g} (+-{span.sigma:.2g})' if span.sigma else NAMED_SPANS.get(
        span.size, f'{span.size:.0f}')
    found = Reason(Code.WHEEL_COUNTERS_DIFFER, f'the {side} wheel counter rolls over at {about}, '
                   f'not at the range of its message type: {times} jump{"s" * (times > 1)} of '
                   f'this size against the travel, first at t = {t[span.rows[0] + 1]:.2f} s; '
                   'corrected')
    # one error of the span for all jumps; the budget treats uncertainties as independent
    doubt = np.full(times, span.sigma * np.sqrt(times))
    return (replace(samples, value=value), (found,),
            *((t[span.rows], doubt) if span.sigma else (none, none)))
