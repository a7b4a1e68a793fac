# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of legs of different vehicles or settings, which must not be combined."""

from collections.abc import Sequence
import math
from typing import NamedTuple

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.result import Estimate, LegResult
from odocal_ros.nav.angles import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS, TYRE_SPREAD


def unlike_legs(numbered: Sequence[tuple[int, LegResult]]) -> tuple[Reason, ...]:
    """
    Return LEGS_UNLIKE if scale or yaw of legs differ by more than those of one vehicle.

    numbered : the combined legs, with their numbers.
    """
    found = []
    estimates = [(n, leg_estimates(leg)) for n, leg in numbered]
    scales = [scale for scale in _values('scale_factor', estimates) if scale.value]
    units = dict.fromkeys(scale.unit for scale in scales)
    if len(units) > 1:
        which = '; '.join(f'{unit} in leg '
                          + ', '.join(str(s.leg) for s in scales if s.unit == unit)
                          for unit in units)
        return (Reason(Code.LEGS_UNLIKE, 'the odometers have different units, so their scales '
                       f'cannot be combined: {which}'),)
    far = _farthest(scales)
    if far and (more := far[1].value / far[0].value - 1) > TYRE_SPREAD:
        low, high = far
        found.append(f'the scale of leg {high.leg} is {100 * more:.1f} % above '
                     f'that of leg {low.leg}')
    yaws = _values('yaw_mounting_angle', estimates)
    # of a reversed IMU they are near +-180 deg
    far = _farthest([yaw._replace(value=float(wrap(yaw.value - yaws[0].value))) for yaw in yaws])
    # rad, 5 deg: mountings bend less
    if far and (more := far[1].value - far[0].value) > 0.087:
        low, high = far
        found.append(f'the yaw mounting of leg {high.leg} is {math.degrees(more):.1f} deg above '
                     f'that of leg {low.leg}')
    return (Reason(Code.LEGS_UNLIKE, f'{" and ".join(found)}: larger than changes of one vehicle '
                   'with one mounting'),) if found else ()


class _LegValue(NamedTuple):
    """The estimate of one value by one leg."""

    leg: int
    value: float
    sigma: float
    unit: str


def _values(name: str, estimates: Sequence[tuple[int, dict[str, Estimate]]]) -> list[_LegValue]:
    every = ((n, of_leg.get(name)) for n, of_leg in estimates)
    return [_LegValue(n, e.value, e.sigma, e.unit) for n, e in every
            if e is not None and e.value is not None and e.sigma is not None]


def _farthest(values: list[_LegValue]) -> tuple[_LegValue, _LegValue] | None:
    """Return the lowest and the highest value if they differ significantly."""
    if len(values) < 2:
        return None
    order = sorted(values, key=lambda one: one.value)
    low, high = order[0], order[-1]
    noise = (high.sigma**2 + low.sigma**2)**0.5
    return (low, high) if high.value - low.value > FAULT_SIGMAS * noise else None
