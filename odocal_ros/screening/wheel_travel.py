# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Travel of one or two wheels: each counter corrected separately, then their mean."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.nav.odometer import mean_travel, Travel, travel
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.late_rows import on_time
from odocal_ros.screening.odometer_care import counter_steps, doubted, mended
from odocal_ros.screening.wheel_counters import unrolled
from odocal_ros.settings.config import Config


@dataclass(frozen=True, eq=False)
class Wheels:
    """
    Travel of the wheels, and its uncertain parts.

    each : the only wheel or all.   doubts : of each, where it is uncertain and by how much, (k,) s
    and (k,) scale units.
    """

    each: tuple[Travel, ...]
    doubts: tuple[tuple[Floats, Floats], ...]

    @cached_property
    def mean(self) -> Travel:
        """Return the mean of the wheels that do not steer; the first one if another is empty."""
        fixed = [self.each[k] for k in self._fixed]
        return mean_travel(fixed) if all(len(one.t) for one in fixed) else fixed[0]

    @property
    def several(self) -> tuple[Travel, ...]:
        """Return each of several wheels, () of one."""
        return self.each if len(self.each) > 1 else ()

    @property
    def doubt_t(self) -> Floats:
        """Return the times at which the mean is uncertain, s."""
        return np.concatenate([self.doubts[k][0] for k in self._fixed])

    @property
    def doubt_sigma(self) -> Floats:
        """Return the sigmas of the mean at these times, scale units."""
        sigma: Floats = np.concatenate([self.doubts[k][1] for k in self._fixed])
        return sigma / len(self._fixed)

    @property
    def _fixed(self) -> list[int]:
        return [k for k, one in enumerate(self.each) if not one.ahead]

    def only(self, wheels: Sequence[Travel]) -> 'Wheels':
        """Return some of the wheels, as given."""
        doubts = {one.name: doubt for one, doubt in zip(self.each, self.doubts, strict=True)}
        return Wheels(tuple(wheels), tuple(doubts[one.name] for one in wheels))


def wheels(leg: Leg, config: Config, rows: Callable[[str], tuple[Any, Floats]],
           found: list[Reason]) -> Wheels:
    """
    Return the travel of the wheels of a leg.

    rows : callable, a slot's usable rows and their times, s.   found : list that findings join.
    """
    slots = leg.wheel_slots
    names = config.odometer.names(len(slots))
    samples, t = rows(slots[0])
    if len(slots) == 1 and len(config.odometer.keys) > 1 and len(t):
        found.append(Reason(Code.WHEEL_DEAD, 'the right wheel has no message between the '
                            'marks: only the left wheel is used'))
    each = [_one(samples, t, leg.form, config, found, names[0])]
    for slot, name in zip(slots[1:], names[1:], strict=True):
        form = leg.form_of(slot)
        if _kind(form) != _kind(leg.form):
            found.append(Reason(Code.WHEEL_COUNTERS_DIFFER, f'the {name} wheel publishes '
                                f'{_words(form)}, the {names[0]} wheel {_words(leg.form)}: they '
                                f'cannot be averaged, so only the {names[0]} wheel is used'))
            return _together(each[:1])
        samples, t = rows(slot)
        if not len(t):
            found.append(Reason(Code.WHEEL_DEAD, f'the {name} wheel has no usable value between '
                                f'the marks: only the {names[0]} wheel is used'))
            return _together(each[:1])
        each.append(_one(samples, t, form, config, found, name))
    return _together(each)


def _together(each: list[tuple[Travel, Floats, Floats]]) -> Wheels:
    return Wheels(tuple(one[0] for one in each), tuple(one[1:] for one in each))


def _one(samples: OdometerSamples, t: Floats, form: OdometerForm, config: Config,
         found: list[Reason], side: str = '') -> tuple[Travel, Floats, Floats]:
    """Return the travel of a wheel, and times and sigmas of uncertain travel."""
    name = f"the {side} wheel's counter" if side else 'the counter'
    doubt_t = doubt = np.empty(0)
    if side and form.quantity == 'cumulative':
        step = counter_steps(samples.value, form.modulus)
        samples, why, doubt_t, doubt = unrolled(t, samples, step, side)
        found.extend(why)
    samples, t = mended(samples, t, form, found, f'{side} odometer'.strip())
    t = on_time(samples, t, form, found, f'{side} odometer'.strip())
    counts, reasons = travel(t, samples.value, form, config.odometer.reversed, name)
    found.extend(reasons)
    counts, more_t, more = doubted(counts, samples.value, form)
    return replace(counts, name=side), np.append(doubt_t, more_t), np.append(doubt, more)


def _kind(form: OdometerForm) -> tuple[str, str]:
    return form.quantity, form.scale_unit


def _words(form: OdometerForm) -> str:
    """Return the meaning of the values of a form, for people."""
    what = {'cumulative': 'a running count', 'increment': 'increments', 'rate': 'a speed'}
    return f'{what[form.quantity]} ({form.scale_unit})'
