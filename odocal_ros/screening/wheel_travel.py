# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Travel of one or more wheels: each counter corrected separately, then their mean.

Wheel counters can roll over below the range of their message type, each differently: one driver
uses 64 bits, the other 16 in a message of 64. Such rollovers are jumps opposite to the travel, all
of the same size: the span.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, Ints, Values
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.nav.odometer import make_travel, mean_travel, MIN_STEPS, Travel
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening import odometer_rows
from odocal_ros.screening.inputs import UsableRows
from odocal_ros.screening.late_rows import sampling_times
from odocal_ros.settings.config import Config

# known spans of integer counts, and of angles in rad or deg
SPANS = {'integer': 2.0 ** np.arange(6, 54), 'angle': np.array([2 * np.pi, 4 * np.pi, 360.0])}
NAMED_SPANS = {float(2 * np.pi): '2 pi', float(4 * np.pi): '4 pi'}


@dataclass(frozen=True, eq=False)
class RolloverSpan:
    """Rollovers of a counter: its span in counts, its sigma, and the rows before them."""

    size: float
    sigma: float                 # 0: certain
    rows: NDArray[np.int64]      # (k,)
    turns: NDArray[np.int64]     # (k,) +1 rolled over upwards, -1 downwards


def hidden_span(value: Values, step: Floats) -> RolloverSpan | None:
    """Return the rollovers of a counter by values, (n,), and steps, (n - 1,); None without any."""
    # they are jumps against the travel, relative to the usual step, a running median
    if len(step) < MIN_STEPS or not step.any():
        return None
    side_steps = 7    # on each side of a step, in its running median
    padded = np.pad(step, side_steps, mode='edge')
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * side_steps + 1),
                      axis=-1)
    is_integer = np.issubdtype(value.dtype, np.integer)
    jump = step - usual
    largest_usual = float(np.percentile(np.abs(usual), 99.9))
    min_jump = 8.0    # counts
    is_large = np.abs(jump) > np.maximum(2 * np.abs(usual) + min_jump * is_integer,
                                         1.5 * largest_usual)
    # only against the travel: a frozen counter catches up with a jump along it
    rows = np.flatnonzero(is_large & (jump * usual <= 0))
    if not len(rows):
        return None
    size = np.abs(jump[rows])
    tolerance = np.abs(usual[rows]) / 2 + (3.0 if is_integer else 1e-3 * size)
    span, sigma = _estimate_span(value, rows, float(np.median(size)),
                                 float(np.median(tolerance)))
    agrees = np.abs(size - span) <= 2 * tolerance
    min_agreeing = 0.8    # share of the jumps; none agrees with NaN
    if agrees.mean() < min_agreeing:
        return None
    rows = rows[agrees]
    if _value_range(value, rows) > span + np.median(tolerance):   # rows out of order, two counters
        return None
    return RolloverSpan(span, sigma, rows, -np.sign(jump[rows]).astype(np.int64))


def _estimate_span(value: Values, rows: Ints, size: float,
                   tolerance: float) -> tuple[float, float]:
    """
    Return the span of a counter and its sigma, 0 if certain; (NaN, 0) if it has none.

    rows : (k,) rows before the jumps.   size, tolerance : median size of the jumps, and its error.
    """
    is_integer = np.issubdtype(value.dtype, np.integer)
    spans = SPANS['integer' if is_integer else 'angle']
    known = float(spans[np.argmin(np.abs(spans - size))])
    # judgement, of the span: largest deviation of a single jump from a known span
    single_limit = np.inf if len(rows) > 1 else 0.01 * known
    if abs(known - size) <= min(tolerance, single_limit):
        return known, 0.0
    min_jumps = 3    # for a span that is not a known one
    if len(rows) < min_jumps:
        return np.nan, 0.0
    if not is_integer:
        return size, tolerance / np.sqrt(3 * len(rows))
    span, sigma = _roundest_span(value, rows, size, tolerance)
    return (span, sigma) if span <= spans[-1] else (np.nan, 0.0)    # wider: values are damaged


def _value_range(value: Values, rows: Ints) -> float:
    """Return the range of the values before and after jumps, which is less than the span."""
    return float(np.ptp(np.stack([value[rows], value[rows + 1]]).astype(float)))


def _roundest_span(value: Values, rows: Ints, size: float,
                   tolerance: float) -> tuple[float, float]:
    """Return the roundest number that can be the span, and its sigma; see ``_estimate_span``."""
    low = _value_range(value, rows) + 1
    high = max(low, size + 2 * tolerance / np.sqrt(len(rows)))
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
    of the message type's range corrected.   name : of the counter, in reasons.   only_counter :
    the vehicle has no other one. Times are (k,) s, sigmas (k,) counts.
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
    angle = span.size in NAMED_SPANS     # exact, but odometer.wrap needs an integer
    code = Code.COUNTER_ROLLOVER if only_counter or angle else Code.WHEEL_COUNTERS_DIFFER
    remedy = '' if angle else f'Set odometer.wrap to {span.size:.0f}.' if only_counter else (
        f'If both wheels have this modulus, set odometer.wrap to {span.size:.0f}. Otherwise '
        'correct the driver: odometer.wrap is for both.')
    # judgement: few counters roll over so often; values of two counters alternate
    two_publishers = times > 0.1 * len(step)
    reason = Reason(code, f'{name} rolls over at {about}, below the range of its message type; '
                    f'{times} jump{"s" * (times > 1)} of this size opposite to the travel, '
                    f'first at t = {t[span.rows[0] + 1]:.2f} s, removed from the travel'
                    + '. Check for two publishers on the topic if the counter cannot roll over so '
                    'often' * two_publishers, remedy)
    # one error of the span for all jumps; the budget treats uncertainties as independent
    uncertain_sigma = np.full(times, span.sigma * np.sqrt(times))
    return (replace(samples, value=value), (reason,),
            *((t[span.rows], uncertain_sigma) if span.sigma else (none, none)))


@dataclass(frozen=True, eq=False)
class Wheels:
    """Travel of the wheels, and its uncertain parts."""

    wheels: tuple[Travel, ...]
    # name of a wheel -> times of uncertain travel, (k,) s, and its sigmas, (k,) scale units
    uncertain_travel: dict[str, tuple[Floats, Floats]]

    @property
    def _unsteered(self) -> list[Travel]:
        return [wheel for wheel in self.wheels if not wheel.distance_ahead]

    @cached_property
    def mean(self) -> Travel:
        """Return the mean of the wheels that do not steer; the first one if another is empty."""
        unsteered = self._unsteered
        return mean_travel(unsteered) if all(len(wheel.t) for wheel in unsteered) else unsteered[0]

    @property
    def uncertain_t(self) -> Floats:
        """Return the times at which the mean is uncertain, s."""
        return np.concatenate([self.uncertain_travel[wheel.name][0] for wheel in self._unsteered])

    @property
    def uncertain_sigma(self) -> Floats:
        """Return the sigmas of the mean at these times, scale units."""
        sigma: Floats = np.concatenate([self.uncertain_travel[wheel.name][1]
                                        for wheel in self._unsteered])
        return sigma / len(self._unsteered)


def travel_of_wheels(leg: Leg, config: Config,
                     usable_rows: Callable[[str], tuple[UsableRows, list[Reason]]],
                     ) -> tuple[Wheels, list[Reason]]:
    """
    Return the travel of the wheels of a leg, and reasons.

    usable_rows : function of a slot that returns its usable rows, and reasons for the others.
    """
    slots = leg.wheel_slots
    names = config.odometer.names(len(slots))
    wheels, uncertain, reasons = list[Travel](), dict[str, tuple[Floats, Floats]](), list[Reason]()
    for slot, name in zip(slots, names, strict=True):
        form = leg.form_of(slot)
        if _form_text(form) != _form_text(leg.form):
            reasons.append(Reason(
                Code.WHEEL_COUNTERS_DIFFER, f'the {name} wheel publishes {_form_text(form)}, the '
                f'{names[0]} wheel {_form_text(leg.form)}: they cannot be averaged, so only the '
                f'{names[0]} wheel is used', 'Publish both wheels as one kind of value. If only '
                'the modulus differs, set odometer.wrap.'))
            return Wheels(tuple(wheels[:1]), uncertain), reasons
        (samples, t), row_reasons = usable_rows(slot)
        reasons += row_reasons
        if wheels and not len(t):
            reasons.append(Reason(
                Code.WHEEL_DEAD, f'the {name} wheel has no usable value between the marks: only '
                f'the {names[0]} wheel is used'))
            return Wheels(tuple(wheels[:1]), uncertain), reasons
        if len(slots) == 1 and len(config.odometer.wheel_keys) > 1 and len(t):
            reasons.append(Reason(Code.WHEEL_DEAD, 'the right wheel has no message between the '
                                  'marks: only the left wheel is used'))
        wheel, uncertain[name], wheel_reasons = _corrected_travel(samples, t, form, config, name)
        wheels.append(wheel)
        reasons += wheel_reasons
    return Wheels(tuple(wheels), uncertain), reasons


def _corrected_travel(samples: OdometerSamples, t: Floats, form: OdometerForm, config: Config,
                      side: str) -> tuple[Travel, tuple[Floats, Floats], list[Reason]]:
    """Return the travel of a wheel, times, s, and sigmas of its uncertain travel, and reasons."""
    name = f"the {side} wheel's counter" if side else 'the counter'
    odometer = f'{side} odometer'.strip()
    uncertain_t = uncertain_sigma = np.empty(0)
    reasons: list[Reason] = []
    if form.quantity == 'cumulative':
        step = odometer_rows.counter_steps(samples.value, form.modulus)
        samples, rollover_reasons, uncertain_t, uncertain_sigma = correct_rollovers(
            t, samples, step, name, only_counter=not side)
        reasons += rollover_reasons
    samples, t, false_reasons = odometer_rows.without_false_rows(samples, t, form, odometer)
    t, late_reasons = sampling_times(samples, t, form, odometer)
    travel, reset_reasons = make_travel(t, samples.value, form, config.odometer.reversed, name)
    travel, gap_t, gap_sigma = odometer_rows.with_gap_uncertainty(travel, samples.value, form)
    return (replace(travel, name=side),
            (np.append(uncertain_t, gap_t), np.append(uncertain_sigma, gap_sigma)),
            [*reasons, *false_reasons, *late_reasons, *reset_reasons])


def _form_text(form: OdometerForm) -> str:
    texts = {'cumulative': 'a running count', 'increment': 'increments', 'rate': 'a speed'}
    return f'{texts[form.quantity]} ({form.scale_unit})'
