# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Travel of one or more wheels: each counter corrected separately, then their mean.

Wheel counters can roll over below the range of their message type, each differently: one driver
uses 64 bits, the other 16 in a message of 64. Such rollovers are jumps opposite to the travel, all
of the same size: the span.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, Ints, Values
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.nav.odometer import FEWEST_STEPS, make_travel, mean_travel, Travel
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.late_rows import sampling_times
from odocal_ros.screening.odometer_rows import (
    counter_steps,
    with_gap_uncertainty,
    without_false_rows,
)
from odocal_ros.settings.config import Config

SPANS = {'whole': 2.0 ** np.arange(6, 54), 'angle': np.array([2 * np.pi, 4 * np.pi, 360.0])}
NAMED_SPANS = {float(2 * np.pi): '2 pi', float(4 * np.pi): '4 pi'}


@dataclass(frozen=True, eq=False)
class Span:
    """Rollovers of a counter: its span in counts, its sigma, and the rows before them."""

    size: float
    sigma: float                 # 0: certain
    rows: NDArray[np.int64]      # (k,)
    turns: NDArray[np.int64]     # (k,) +1 rolled over upwards, -1 downwards


def hidden_span(value: Values, step: Floats) -> Span | None:
    """Return the span of a counter's uncorrected rollovers, by rows (n,) and steps (n - 1,)."""
    if len(step) < FEWEST_STEPS or not step.any():
        return None
    median_reach = 7    # steps on each side of a jump, whose median is the usual step
    padded = np.pad(step, median_reach, mode='edge')
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * median_reach + 1),
                      axis=-1)
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
    fewest_jumps = 3    # least number of jumps for a span that is no power of two
    # judgement, of the span: largest deviation from a power of two of a single jump
    most_off = np.inf if len(rows) > 1 else 0.01 * known
    if abs(known - middle) <= min(typical, most_off):
        span = known
    elif len(rows) >= fewest_jumps:
        span, sigma = _measured_span(value, rows, middle, typical) if whole else (
            middle, typical / np.sqrt(3 * len(rows)))
    else:
        return None
    if whole and span > spans[-1]:       # damaged values: wider than any counter
        return None
    agree = np.abs(size - span) <= 2 * slack
    same_span_share = 0.8    # share of the jumps that must agree
    if agree.mean() < same_span_share:
        return None
    rows = rows[agree]
    if _value_range(value, rows) > span + typical:     # rows out of order, two counters
        return None
    return Span(span, sigma, rows, -np.sign(off[rows]).astype(np.int64))


def _value_range(value: Values, rows: Ints) -> float:
    """Return the range of the values before and after the jumps, which is within one span."""
    return float(np.ptp(np.stack([value[rows], value[rows + 1]]).astype(float)))


def _measured_span(value: Values, rows: Ints, middle: float, slack: float) -> tuple[float, float]:
    """Return a span that is no power of two, and its sigma: the roundest number that fits."""
    low = _value_range(value, rows) + 1
    high = max(low, middle + 2 * slack / np.sqrt(len(rows)))
    for unit in (1e6, 1e5, 1e4, 1e3, 1e2):
        span = np.ceil(low / unit) * unit
        if span <= high:
            return float(span), 0.0
    return float(round((low + high) / 2)), max(1.0, (high - low) / np.sqrt(12))


def correct_rollovers(
        t: Floats, samples: OdometerSamples, step: Floats, name: str, *, only_counter: bool = True,
        ) -> tuple[OdometerSamples, tuple[Reason, ...], Floats, Floats]:
    """
    Return rows with hidden rollovers corrected, reasons, times and sigmas of uncertain travel.

    t, samples : (n,) s, and usable rows of a running count.   step : (n - 1,) its steps, rollovers
    of the type's span corrected.   name : of the counter, in reasons.   only_counter : there is no
    other one. Times are (k,) s, sigmas (k,) counts.
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
    about = f'about {span.size:.0f} (± {span.sigma:.0f})' if span.sigma else NAMED_SPANS.get(
        span.size, f'{span.size:.0f}')
    angle = span.size in NAMED_SPANS     # exact, and no modulus of odometer.wrap, which is whole
    code = Code.COUNTER_ROLLOVER if only_counter or angle else Code.WHEEL_COUNTERS_DIFFER
    do = f'Set odometer.wrap to {span.size:.0f}.' if only_counter and not angle else ''
    twice = times > 0.1 * len(step)     # judgement: few counters do so; the steps of two alternate
    found = Reason(code, f'{name} rolls over at {about}, below the range of its message type; '
                   f'{times} jump{"s" * (times > 1)} of this size opposite to the travel, '
                   f'first at t = {t[span.rows[0] + 1]:.2f} s, removed from the travel'
                   + '. Check for two publishers on the topic if the counter cannot roll over so '
                   'often' * twice, do)
    # one error of the span for all jumps; the budget treats uncertainties as independent
    uncertain_sigma = np.full(times, span.sigma * np.sqrt(times))
    return (replace(samples, value=value), (found,),
            *((t[span.rows], uncertain_sigma) if span.sigma else (none, none)))


@dataclass(frozen=True, eq=False)
class Wheels:
    """Travel of the wheels, and its uncertain parts."""

    wheels: tuple[Travel, ...]
    # of each: times of uncertain travel, (k,) s, and its sigmas, (k,) scale units
    uncertain_travel: tuple[tuple[Floats, Floats], ...]

    @cached_property
    def mean(self) -> Travel:
        """Return the mean of the wheels that do not steer; the first one if another is empty."""
        fixed = [self.wheels[k] for k in self._fixed]
        return mean_travel(fixed) if all(len(one.t) for one in fixed) else fixed[0]

    @property
    def uncertain_t(self) -> Floats:
        """Return the times at which the mean is uncertain, s."""
        return np.concatenate([self.uncertain_travel[k][0] for k in self._fixed])

    @property
    def uncertain_sigma(self) -> Floats:
        """Return the sigmas of the mean at these times, scale units."""
        sigma: Floats = np.concatenate([self.uncertain_travel[k][1] for k in self._fixed])
        return sigma / len(self._fixed)

    @property
    def _fixed(self) -> list[int]:
        return [k for k, one in enumerate(self.wheels) if not one.ahead]

    def only(self, kept: Sequence[Travel]) -> 'Wheels':
        """Return the travel of the kept ones of the wheels, and their uncertain parts."""
        by_name = {wheel.name: uncertain for wheel, uncertain in zip(
            self.wheels, self.uncertain_travel, strict=True)}
        return Wheels(tuple(kept), tuple(by_name[wheel.name] for wheel in kept))


def travel_of_wheels(leg: Leg, config: Config, rows: Callable[[str], tuple[Any, Floats]],
                     found: list[Reason]) -> Wheels:
    """Return the travel of the wheels of a leg; rows: of a slot the usable rows and times, s."""
    slots = leg.wheel_slots
    names = config.odometer.names(len(slots))
    samples, t = rows(slots[0])
    if len(slots) == 1 and len(config.odometer.keys) > 1 and len(t):
        found.append(Reason(Code.WHEEL_DEAD, 'the right wheel has no message between the '
                            'marks: only the left wheel is used'))
    wheels = [_corrected_travel(samples, t, leg.form, config, found, names[0])]
    for slot, name in zip(slots[1:], names[1:], strict=True):
        form = leg.form_of(slot)
        if _form_text(form) != _form_text(leg.form):
            found.append(Reason(
                Code.WHEEL_COUNTERS_DIFFER, f'the {name} wheel publishes {_form_text(form)}, the '
                f'{names[0]} wheel {_form_text(leg.form)}: they cannot be averaged, so only the '
                f'{names[0]} wheel is used'))
            return _joined(wheels[:1])
        samples, t = rows(slot)
        if not len(t):
            found.append(Reason(Code.WHEEL_DEAD, f'the {name} wheel has no usable value between '
                                f'the marks: only the {names[0]} wheel is used'))
            return _joined(wheels[:1])
        wheels.append(_corrected_travel(samples, t, form, config, found, name))
    return _joined(wheels)


def _joined(wheels: list[tuple[Travel, Floats, Floats]]) -> Wheels:
    return Wheels(tuple(one[0] for one in wheels), tuple(one[1:] for one in wheels))


def _corrected_travel(samples: OdometerSamples, t: Floats, form: OdometerForm, config: Config,
                      found: list[Reason], side: str = '') -> tuple[Travel, Floats, Floats]:
    name = f"the {side} wheel's counter" if side else 'the counter'
    uncertain_t = uncertain_sigma = np.empty(0)
    if form.quantity == 'cumulative':
        step = counter_steps(samples.value, form.modulus)
        samples, why, uncertain_t, uncertain_sigma = correct_rollovers(
            t, samples, step, name, only_counter=not side)
        found.extend(why)
    samples, t = without_false_rows(samples, t, form, found, f'{side} odometer'.strip())
    t = sampling_times(samples, t, form, found, f'{side} odometer'.strip())
    counts, reasons = make_travel(t, samples.value, form, config.odometer.reversed, name)
    found.extend(reasons)
    counts, more_t, more = with_gap_uncertainty(counts, samples.value, form)
    return (replace(counts, name=side), np.append(uncertain_t, more_t),
            np.append(uncertain_sigma, more))


def _form_text(form: OdometerForm) -> str:
    what = {'cumulative': 'a running count', 'increment': 'increments', 'rate': 'a speed'}
    return f'{what[form.quantity]} ({form.scale_unit})'
