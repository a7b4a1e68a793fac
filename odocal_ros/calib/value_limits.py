# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Limits of the sigmas and of the deviation from nominal values, and likely causes of changes."""

from collections.abc import Mapping

import numpy as np

from odocal_ros.calib.number_text import relative_with_limit, with_limit
from odocal_ros.calib.result import Estimate
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import SCALE_LIMIT, TYRE_SPREAD

# definition: units of speed, in m/s
SPEED_UNITS = {1.0: 'm/s', 1 / 3.6: 'km/h', 0.44704: 'mph', 1852 / 3600: 'knots', 0.3048: 'ft/s',
               0.01: 'cm/s', 1e-3: 'mm/s'}
# likely causes of a wrong scale: by its unit, then its ratio to the nominal one. Physical,
# definitions
UNIT_RATIOS = {
    '1': {factor: f'speeds in {name}' for factor, name in SPEED_UNITS.items() if factor != 1}
    | {0.3048: 'speeds in ft/s, or for rad/s of a wheel of this radius in m'},
    'm/rad': {np.pi / 180: 'angles in degrees', 2 * np.pi: 'whole turns',
              np.pi / 30: 'rates in rpm'},
    'm/pulse': {0.25: 'counting four edges per pulse (x4)',
                0.5: 'counting two edges per pulse (x2)'}}
TYRE_CHANGE_LIMIT = 2 * TYRE_SPREAD    # relative, physical: largest change that tyres cause
TYRE_CAUSE = 'tyre pressure, wear, load or another tyre'
OTHER_CAUSE = 'another vehicle, gear, counter or unit: tyres do not change this much'


def _likely_cause(ratio: float, unit: str, nominal: float) -> tuple[str, str]:
    """Return the likely cause and the action, '' if unknown; ratio: scale to ``nominal``."""
    for typical, cause in UNIT_RATIOS.get(unit, {}).items():
        if abs(ratio / typical - 1) < 0.04:    # tolerance for tyres: the ratios are farther apart
            return f', typical for {cause}', (
                f'If so, set odometer.nominal_scale to {typical * nominal:.6g}, or correct the '
                'odometer driver. Otherwise check the odometer. The limit is '
                'odometer.max_scale_deviation.')
    return '', ''


def speed_unit(scale: float) -> tuple[float, str]:
    """Return the unit of a speed nearest to ``scale``, m/s, and its name; scale and '' if none."""
    max_error = 0.2    # judgement: relative, of a speedometer and of a rough scale
    factor = min(SPEED_UNITS, key=lambda unit: abs(scale / unit - 1))
    return (factor, SPEED_UNITS[factor]) if abs(scale / factor - 1) < max_error else (scale, '')


def check_limits(estimates: Mapping[str, Estimate], nominal_scale: float,
                 config: Config) -> tuple[Reason, ...]:
    """
    Return the reasons of a scale or yaw with too large a sigma, or a scale far from nominal.

    nominal_scale : in the unit of the scale, 0 if unknown.   config : the limits.
    """
    reasons = []
    scale, yaw = estimates['scale_factor'], estimates['yaw_mounting_angle']
    if scale.value is not None:
        relative = 0.0 if scale.sigma is None else scale.sigma / scale.value
        limit = config.verdict.max_scale_sigma
        if relative > SCALE_LIMIT:
            reasons.append(Reason(Code.SCALE_NOT_DETERMINED, 'scale uncertainty is '
                                  f'{100 * relative:.0f} %, too large for a usable value; the '
                                  f'limit is {100 * SCALE_LIMIT:g} %'))
        elif relative > limit:
            reasons.append(Reason(Code.SCALE_SIGMA_TOO_LARGE, 'scale uncertainty is '
                                  + relative_with_limit(relative, limit)))
        reasons += far_from_nominal(scale.value, scale.unit, nominal_scale, config)
    if yaw.value is not None and yaw.sigma is not None \
            and yaw.sigma > config.verdict.max_yaw_sigma:
        sigma, sigma_limit = np.rad2deg([yaw.sigma, config.verdict.max_yaw_sigma])
        reasons.append(Reason(Code.YAW_SIGMA_TOO_LARGE, 'yaw uncertainty is '
                              + with_limit(sigma, sigma_limit, 'deg')))
    return tuple(reasons)


def far_from_nominal(scale: float, unit: str, nominal: float, config: Config) -> list[Reason]:
    """Return SCALE_FAR_FROM_NOMINAL beyond max_scale_deviation; nominal: 0 if unknown."""
    deviation = scale / nominal - 1 if nominal else 0.0
    if abs(deviation) <= config.odometer.max_scale_deviation:
        return []
    cause, action = _likely_cause(deviation + 1, unit, nominal)
    unit_text = '' if unit == '1' else f' {unit}'
    text = (f'scale {scale:.6g}{unit_text} is {100 * deviation:+z.1f} % from the nominal value '
            f'{nominal:.6g}{cause}')
    return [Reason(Code.SCALE_FAR_FROM_NOMINAL, text, action)]


def cause_of_change(relative: float) -> str:
    """Return the likely cause of a relative change of the scale."""
    return OTHER_CAUSE if abs(relative) > TYRE_CHANGE_LIMIT else TYRE_CAUSE
