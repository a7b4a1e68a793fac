# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Travel of one or more wheels: each counter corrected separately, then their mean.

Wheel counters can roll over below the range of their message type, each differently: one driver
uses 64 bits, the other 16 in a message of 64. Such rollovers are jumps opposite to the travel, all
of the same size: the modulus.
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
from odocal_ros.screening.odometer_rows import CERTAIN, UncertainTravel
from odocal_ros.settings.config import Config

# known moduli of integer counts, and of angles in rad or deg
KNOWN_MODULI = {'integer': 2.0 ** np.arange(6, 54),
                'angle': np.array([2 * np.pi, 4 * np.pi, 360.0])}
NAMED_MODULI = {float(2 * np.pi): '2 pi', float(4 * np.pi): '4 pi'}


@dataclass(frozen=True, eq=False)
class Rollovers:
    """Rollovers of a counter: its modulus, and the rows before them."""

    modulus: float               # units of the values
    sigma: float                 # of the modulus; 0: certain
    rows: NDArray[np.int64]      # (k,)
    direction: NDArray[np.int64]    # (k,) +1 rolled over upwards, -1 downwards


def find_rollovers(value: Values, step: Floats) -> Rollovers | None:
    """Return the rollovers of a counter by values, (n,), and steps, (n - 1,); None without any."""
    if len(step) < MIN_STEPS or not step.any():
        return None
    is_integer = np.issubdtype(value.dtype, np.integer)
    usual_step = _usual_steps(step)
    rows = _jump_rows(step, usual_step, is_integer)
    if not len(rows):
        return None
    size = np.abs(step - usual_step)[rows]
    # of a jump: half a step, and counts, or rounding of an angle
    tolerance = np.abs(usual_step[rows]) / 2 + (3.0 if is_integer else 1e-3 * size)
    estimate = _estimate_modulus(value, rows, float(np.median(size)), float(np.median(tolerance)))
    if estimate is None:
        return None
    modulus, sigma = estimate
    agrees = np.abs(size - modulus) <= 2 * tolerance
    min_agreeing = 0.8    # share of the jumps
    if agrees.mean() < min_agreeing:
        return None
    rows = rows[agrees]
    # a larger range: likely rows out of order, or two counters
    if _value_range(value, rows) > modulus + np.median(tolerance):
        return None
    return Rollovers(modulus, sigma, rows, -np.sign((step - usual_step)[rows]).astype(np.int64))


def _usual_steps(step: Floats) -> Floats:
    """Return the running median of steps: (n,)."""
    side_steps = 7    # on each side of a step, in its running median
    padded = np.pad(step, side_steps, mode='edge')
    return np.asarray(np.median(
        np.lib.stride_tricks.sliding_window_view(padded, 2 * side_steps + 1), axis=-1))


def _jump_rows(step: Floats, usual_step: Floats, is_integer: bool) -> Ints:
    """Return the rows before jumps against the travel, relative to the usual step: (k,)."""
    jump = step - usual_step
    largest_usual = float(np.percentile(np.abs(usual_step), 99.9))
    min_jump = 8.0    # counts
    is_large = np.abs(jump) > np.maximum(2 * np.abs(usual_step) + min_jump * is_integer,
                                         1.5 * largest_usual)
    # only against the travel: a frozen counter catches up with a jump along it
    return np.flatnonzero(is_large & (jump * usual_step <= 0))


def _estimate_modulus(value: Values, rows: Ints, size: float,
                      tolerance: float) -> tuple[float, float] | None:
    """
    Return the modulus of a counter and its sigma, 0 if certain; None if it has none.

    rows : (k,) rows before the jumps.   size, tolerance : median size of the jumps, and its error.
    """
    is_integer = np.issubdtype(value.dtype, np.integer)
    moduli = KNOWN_MODULI['integer' if is_integer else 'angle']
    known = float(moduli[np.argmin(np.abs(moduli - size))])
    # judgement, of the modulus: largest deviation of a single jump from a known one
    single_limit = np.inf if len(rows) > 1 else 0.01 * known
    if abs(known - size) <= min(tolerance, single_limit):
        return known, 0.0
    min_jumps = 3    # for a modulus that is not a known one
    if len(rows) < min_jumps:
        return None
    if not is_integer:
        return size, tolerance / np.sqrt(3 * len(rows))
    modulus, sigma = _roundest_modulus(value, rows, size, tolerance)
    return (modulus, sigma) if modulus <= moduli[-1] else None    # larger: values are damaged


def _value_range(value: Values, rows: Ints) -> float:
    """Return the range of the values before and after jumps, which is less than the modulus."""
    return float(np.ptp(np.stack([value[rows], value[rows + 1]]).astype(float)))


def _roundest_modulus(value: Values, rows: Ints, size: float,
                      tolerance: float) -> tuple[float, float]:
    """
    Return the modulus and its sigma; as ``_estimate_modulus``.

    Of the possible values it is a multiple of the largest power of ten; without any, their middle.
    """
    low = _value_range(value, rows) + 1
    high = max(low, size + 2 * tolerance / np.sqrt(len(rows)))
    for unit in (1e6, 1e5, 1e4, 1e3, 1e2):
        modulus = np.ceil(low / unit) * unit
        if modulus <= high:
            return float(modulus), 0.0
    return float(round((low + high) / 2)), max(1.0, (high - low) / np.sqrt(12))


def correct_rollovers(
        t: Floats, samples: OdometerSamples, step: Floats, name: str, *, only_counter: bool = True,
        ) -> tuple[OdometerSamples, tuple[Reason, ...], UncertainTravel]:
    """
    Return rows with rollovers corrected, reasons, and the uncertain travel, in counts.

    t, samples : (n,) s, and usable rows of a running count.   step : (n - 1,) its steps, rollovers
    of the message type's range corrected.   name : of the counter, in reasons.   only_counter :
    the vehicle has no other one.
    """
    rollovers = find_rollovers(samples.value, step)
    if rollovers is None:
        return samples, (), CERTAIN
    direction = np.zeros(len(t), np.int64)
    direction[rollovers.rows + 1] = rollovers.direction
    is_integer = np.issubdtype(samples.value.dtype, np.integer)
    modulus = round(rollovers.modulus) if is_integer else rollovers.modulus
    value: NDArray[Any] = samples.value + modulus * np.cumsum(direction)
    # one error of the modulus for all jumps; the budget treats uncertainties as independent
    sigma = rollovers.sigma * np.sqrt(len(rollovers.rows))
    uncertain = UncertainTravel(t[rollovers.rows],
                                np.full(len(rollovers.rows), sigma)) if sigma else CERTAIN
    return (replace(samples, value=value),
            (_rollover_reason(rollovers, t, name, only_counter),), uncertain)


def _rollover_reason(rollovers: Rollovers, t: Floats, name: str, only_counter: bool) -> Reason:
    """Return the reason that reports rollovers; arguments as for ``correct_rollovers``."""
    count, modulus = len(rollovers.rows), f'{rollovers.modulus:.0f}'
    is_angle = rollovers.modulus in NAMED_MODULI     # exact, but odometer.wrap needs an integer
    stated = NAMED_MODULI[rollovers.modulus] if is_angle else (
        f'about {modulus} (± {rollovers.sigma:.0f})' if rollovers.sigma else modulus)
    code = Code.COUNTER_ROLLOVER if only_counter or is_angle else Code.WHEEL_COUNTERS_DIFFER
    remedy = '' if is_angle else f'Set odometer.wrap to {modulus}.' if only_counter else (
        f'If both wheels have this modulus, set odometer.wrap to {modulus}. Otherwise '
        'correct the driver: odometer.wrap is for both.')
    text = (f'{name} rolls over at {stated}, below the range of its message type; {count} '
            f'jump{"s" * (count > 1)} of this size opposite to the travel, first at t = '
            f'{t[rollovers.rows[0] + 1]:.2f} s, removed from the travel')
    max_share = 0.1    # of the rows: few counters roll over so often; values of two alternate
    if count > max_share * (len(t) - 1):
        text += ('. Check for two publishers on the topic if the counter cannot roll over so '
                 'often')
    return Reason(code, text, remedy)


@dataclass(frozen=True, eq=False)
class LegWheels:
    """Travel of the wheels, and its uncertain parts."""

    wheels: tuple[Travel, ...]
    uncertain_travel: dict[str, UncertainTravel]      # by name of the wheel

    @property
    def _unsteered(self) -> list[Travel]:
        return [wheel for wheel in self.wheels if not wheel.distance_ahead]

    @cached_property
    def mean(self) -> Travel:
        """Return the mean of the wheels that do not steer; the first one if another is empty."""
        unsteered = self._unsteered
        return mean_travel(unsteered) if all(len(wheel.t) for wheel in unsteered) else unsteered[0]

    @property
    def uncertain_mean(self) -> UncertainTravel:
        """Return the uncertain parts of the mean."""
        t, sigma = map(np.concatenate, zip(*(
            self.uncertain_travel[wheel.name] for wheel in self._unsteered), strict=True))
        return UncertainTravel(t, sigma / len(self._unsteered))


def travel_of_wheels(leg: Leg, config: Config,
                     usable_rows: Callable[[str], tuple[UsableRows, list[Reason]]],
                     ) -> tuple[LegWheels, list[Reason]]:
    """
    Return the travel of the wheels of a leg, and reasons.

    usable_rows : function of a slot that returns its usable rows, and reasons for the others.
    """
    slots = leg.wheel_slots
    names = config.odometer.names(len(slots))
    wheels, uncertain, reasons = list[Travel](), dict[str, UncertainTravel](), list[Reason]()
    for slot, name in zip(slots, names, strict=True):
        form = leg.form_of(slot)
        if _form_text(form) != _form_text(leg.form):
            reasons.append(Reason(
                Code.WHEEL_COUNTERS_DIFFER, f'the {name} wheel publishes {_form_text(form)}, the '
                f'{names[0]} wheel {_form_text(leg.form)}: they cannot be averaged, so only the '
                f'{names[0]} wheel is used', 'Publish both wheels as one kind of value. If only '
                'the modulus differs, set odometer.wrap.'))
            return LegWheels(tuple(wheels[:1]), uncertain), reasons
        (samples, t), row_reasons = usable_rows(slot)
        reasons += row_reasons
        if wheels and not len(t):
            reasons.append(Reason(
                Code.WHEEL_DEAD, f'the {name} wheel has no usable value between the marks: only '
                f'the {names[0]} wheel is used'))
            return LegWheels(tuple(wheels[:1]), uncertain), reasons
        if len(slots) == 1 and len(config.odometer.wheel_keys) > 1 and len(t):
            reasons.append(Reason(Code.WHEEL_DEAD, 'the right wheel has no message between the '
                                  'marks: only the left wheel is used'))
        wheel, uncertain[name], wheel_reasons = _corrected_travel(samples, t, form, config, name)
        wheels.append(wheel)
        reasons += wheel_reasons
    return LegWheels(tuple(wheels), uncertain), reasons


def _corrected_travel(samples: OdometerSamples, t: Floats, form: OdometerForm, config: Config,
                      side: str) -> tuple[Travel, UncertainTravel, list[Reason]]:
    """Return the travel of a wheel, its uncertain travel, and reasons."""
    name = f"the {side} wheel's counter" if side else 'the counter'
    odometer = f'{side} odometer'.strip()
    uncertain, reasons = CERTAIN, list[Reason]()
    if form.quantity == 'cumulative':
        step = odometer_rows.counter_steps(samples.value, form.modulus)
        samples, rollover_reasons, uncertain = correct_rollovers(
            t, samples, step, name, only_counter=not side)
        reasons += rollover_reasons
    samples, t, false_reasons = odometer_rows.without_false_rows(samples, t, form, odometer)
    t, late_reasons = sampling_times(samples, t, form, odometer)
    travel, reset_reasons = make_travel(t, samples.value, form, config.odometer.reversed, name)
    travel, in_gaps = odometer_rows.with_gap_uncertainty(travel, samples.value, form)
    return (replace(travel, name=side),
            UncertainTravel(*map(np.append, uncertain, in_gaps)),
            [*reasons, *false_reasons, *late_reasons, *reset_reasons])


def _form_text(form: OdometerForm) -> str:
    texts = {'cumulative': 'a running count', 'increment': 'increments', 'rate': 'a speed'}
    return f'{texts[form.quantity]} ({form.scale_unit})'
