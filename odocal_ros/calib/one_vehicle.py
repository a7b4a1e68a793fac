"""Legs that are not of one vehicle, or not of one set of settings: they have no mean."""

from dataclasses import replace
import math

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.nav.angles import wrap
from odocal_ros.reasons import Code, Reason

SURE = 5.0           # sigmas
MOST_SCALE = 0.05    # tyres: wear 2 %, pressure and load 1 %, another make 3 %
MOST_YAW = 0.087     # rad (5 deg): no mounting gives way so far


def unlike_legs(numbered) -> tuple[Reason, ...]:
    """
    Return LEGS_UNLIKE where scale or yaw of legs differ by more than one vehicle can.

    numbered : sequence of (number, LegResult), those that are combined.
    """
    found = []
    scales = [(n, e) for n, leg in numbered
              if (e := leg_estimates(leg).get('scale_factor')) is not None and e.value]
    units = dict.fromkeys(e.unit for _, e in scales)
    if len(units) > 1:
        which = '; '.join(f'{unit} in leg {_numbers(n for n, e in scales if e.unit == unit)}'
                          for unit in units)
        return (Reason(Code.LEGS_UNLIKE, f'the odometers are of different kinds, their scales '
                       f'have no mean: {which}'),)
    far = _farthest(scales)
    if far and far[1][1].value / far[0][1].value - 1 > MOST_SCALE:
        (a, low), (b, high) = far
        found.append(f'the scale of leg {b} is {100 * (high.value / low.value - 1):.1f} % above '
                     f'that of leg {a}')
    yaws = [(n, e) for n, leg in numbered if (e := leg_estimates(leg).get(
        'yaw_mounting_angle')) is not None and e.value is not None]
    # of an Imu that faces backwards they lie about +-180 deg
    far = _farthest([(n, replace(e, value=float(wrap(e.value - yaws[0][1].value))))
                     for n, e in yaws])
    if far and far[1][1].value - far[0][1].value > MOST_YAW:
        (a, low), (b, high) = far
        found.append(f'the yaw mounting of leg {b} is '
                     f'{math.degrees(high.value - low.value):.1f} deg above that of leg {a}')
    return (Reason(Code.LEGS_UNLIKE, f'{" and ".join(found)}: more than one vehicle with one '
                   'mounting changes between drives'),) if found else ()


def _farthest(estimates):
    """Return the lowest and the highest of (number, Estimate) that surely differ, () if none."""
    if len(estimates) < 2:
        return ()
    order = sorted(estimates, key=lambda entry: entry[1].value)
    low, high = order[0], order[-1]
    noise = (high[1].sigma**2 + low[1].sigma**2)**0.5
    return (low, high) if high[1].value - low[1].value > SURE * noise else ()


def _numbers(numbers) -> str:
    return ', '.join(map(str, numbers))
