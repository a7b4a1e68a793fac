# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Travel of one or two wheels: each counter corrected separately, then their mean."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Travel of the wheels, and its uncertain parts."""

    mean: Travel
    left: Travel | None
    right: Travel | None
    doubt_t: NDArray[np.float64]        # (k,) s, where
    doubt_sigma: NDArray[np.float64]    # (k,) scale units, how much


def wheels(leg: Leg, config: Config, rows: Callable[[str], tuple[Any, Floats]],
           found: list[Reason]) -> Wheels:
    """
    Return the travel of the wheels of a leg.

    rows : callable, a slot's usable rows and their times, s.   found : list that findings join.
    """
    if not len(leg.odometer_right.stamp_ns):
        samples, t = rows('odometer')
        odometer = config.odometer
        if odometer.left and odometer.right and len(t):
            found.append(Reason(Code.WHEEL_DEAD, 'the right wheel has no message between the '
                                'marks: only the left wheel is used'))
        left, doubt_t, doubt = _one(samples, t, leg.form, config, found)
        return Wheels(left, None, None, doubt_t, doubt)
    form_right = leg.form_right or leg.form
    samples, t = rows('odometer')
    left, t_left, doubt_left = _one(samples, t, leg.form, config, found, 'left')
    if _kind(form_right) != _kind(leg.form):
        found.append(Reason(Code.WHEEL_COUNTERS_DIFFER, 'the right wheel publishes '
                            f'{_words(form_right)}, the left wheel {_words(leg.form)}: they '
                            'cannot be averaged, so only the left wheel is used'))
        return Wheels(left, None, None, t_left, doubt_left)
    samples, t = rows('odometer_right')
    if not len(t):
        found.append(Reason(Code.WHEEL_DEAD, 'the right wheel has no usable value between the '
                            'marks: only the left wheel is used'))
        return Wheels(left, None, None, t_left, doubt_left)
    right, t_right, doubt_right = _one(samples, t, form_right, config, found, 'right')
    mean = mean_travel(left, right) if len(left.t) and len(right.t) else left
    return Wheels(mean, left, right, np.append(t_left, t_right),
                  np.append(doubt_left, doubt_right) / 2)


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
    return counts, np.append(doubt_t, more_t), np.append(doubt, more)


def _kind(form: OdometerForm) -> tuple[str, str]:
    return form.quantity, form.scale_unit


def _words(form: OdometerForm) -> str:
    """Return the meaning of the values of a form, for people."""
    what = {'cumulative': 'a running count', 'increment': 'increments', 'rate': 'a speed'}
    return f'{what[form.quantity]} ({form.scale_unit})'
