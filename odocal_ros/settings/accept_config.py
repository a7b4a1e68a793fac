# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Acceptance limits of a production line, and their short form --accept NAME=LOW:HIGH."""

from dataclasses import dataclass
import math

from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.settings.setting import setting

# results that limits may be set for
ACCEPTED = ('scale_factor', 'scale_ratio', 'yaw_mounting_angle', 'pitch_mounting_angle')
NAN = math.nan
WANTED = ('--accept NAME=LOW:HIGH, such as --accept scale_ratio=0.995:1.005; either limit can be '
          'omitted')
DEG = '_deg'


@dataclass(frozen=True, kw_only=True)
class AcceptConfig:
    scale_factor_min: float = setting(NAN, 'm/pulse, m/rad or 1', about=(
        'Lower acceptance limit of the scale factor: value minus 2 sigma must not be below. NaN: '
        'no limit.'))
    scale_factor_max: float = setting(NAN, 'm/pulse, m/rad or 1', about=(
        'Upper acceptance limit: value plus 2 sigma must not be above.'))
    scale_ratio_min: float = setting(NAN, '1', about='The same for the scale factor relative to '
                                     'its nominal value.')
    scale_ratio_max: float = setting(NAN, '1', about='The same.')
    yaw_mounting_angle_min: float = setting(NAN, 'rad', about='The same for the yaw mounting '
                                            'angle.')
    yaw_mounting_angle_max: float = setting(NAN, 'rad', about='The same.')
    pitch_mounting_angle_min: float = setting(NAN, 'rad', about='The same for the pitch mounting '
                                              'angle.')
    pitch_mounting_angle_max: float = setting(NAN, 'rad', about='The same.')
    strict: bool = setting(False, about='A result with a caution does not pass; it is undecided.')

    def __post_init__(self) -> None:
        for name, (low, high) in self.limits.items():
            if not low < high:
                raise BadConfig(f'accept.{name}_min = {low:g} is not below accept.{name}_max = '
                                f'{high:g}')

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Return lower and upper limit by result, of those that have one; the other is inf."""
        pairs = {name: (getattr(self, f'{name}_min'), getattr(self, f'{name}_max'))
                 for name in ACCEPTED}
        return {name: (-math.inf if math.isnan(low) else low,
                       math.inf if math.isnan(high) else high)
                for name, (low, high) in pairs.items()
                if not (math.isnan(low) and math.isnan(high))}


def parse_accept(text: str) -> dict[str, float]:
    """
    Return the settings of one ``NAME=LOW:HIGH``; of ``NAME_deg`` the limits are in degrees.

    Raises
    ------
    BadUsage
        Not of that form, or of no result that has limits.

    """
    name, equals, limits = (part.strip() for part in text.partition('='))
    low, colon, high = limits.partition(':')
    plain, factor = name, 1.0
    if name.endswith(f'angle{DEG}'):
        plain, factor = name.removesuffix(DEG), math.radians(1.0)
    if plain not in ACCEPTED:
        raise BadUsage(f'--accept {text}: required: one of '
                       + ', '.join(n + f' (or {n}{DEG})' * n.endswith('angle') for n in ACCEPTED))
    if not (equals and colon and limits != ':'):
        raise BadUsage(f'--accept {text}: required: {WANTED}')
    try:
        return {f'accept.{plain}_{side}': float(value) * factor
                for side, value in (('min', low), ('max', high)) if value.strip()}
    except ValueError:
        raise BadUsage(f'--accept {text}: {limits} are not two numbers; required: '
                       f'{WANTED}') from None
