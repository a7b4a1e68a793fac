# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimates of constants that the drive determines, reasons for others, marginal information."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.calib.mounting import FAR_YAW
from odocal_ros.calib.number_text import differing
from odocal_ros.calib.result import Estimate, MethodResult, name_antenna, unknown_values
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.pseudo_observations import PriorRows, SIZES
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.result.remarks import IMU_SCALES
from odocal_ros.estimator.result.wheel_result import unknown_wheels
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import INFORMED_SHARE, SCALE_LIMIT
from odocal_ros.settings.nominal import nominal_yaw

AXIS_NAMES = {'x': 'forward', 'y': 'left', 'z': 'up'}
# rad, judgement: yaw mounting minus its nominal value above which the counts are reversed
REVERSED_YAW = np.deg2rad(135.0)
UNITS = dict.fromkeys(layout.CONSTANTS, 'm') | {
    'yaw_mounting_angle': 'rad', 'pitch_mounting_angle': 'rad', 'odometer_delay': 's',
    'gnss_delay': 's'}
# remedy if an angle would be determined without the factor for model errors
OTHER_WARNINGS = 'Follow the actions of the other warnings first.'
# constants that are stated if the drive determines them: lever arms and delays
OPTIONAL = range(layout.ODO_ARM.start, layout.HEADING)


def refused_result(reasons: Iterable[Reason], scale_unit: str,
                   wheels: Iterable[Travel] = ()) -> MethodResult:
    """Return the result of a leg that the method refuses: every value unknown."""
    estimates = unknown_estimates(scale_unit) | unknown_wheels([w.name for w in wheels],
                                                               scale_unit)
    return MethodResult('smoother', tuple(reasons), estimates, PARAMETERS)


def implausible_imu_reasons(fit: Fit) -> list[Reason]:
    """Return the reason for a scale error that no IMU has, [] if there is none."""
    c = fit.state.constants
    worst = max(IMU_SCALES, key=lambda i: abs(c[i]))
    limit = 0.2        # twenty times the error of a consumer IMU
    if abs(c[worst]) <= limit:
        return []
    return [Reason(Code.NOT_CONVERGED, 'the fit converged to an error of '
                   f'{layout.CONSTANTS[worst].replace("_", " ")} of {100 * c[worst]:+z.0f} %, '
                   f'impossible for an IMU (limit {100 * limit:.0f} %). Likely cause: wrong '
                   'units, axes or time offsets, or a local minimum')]


def unknown_estimates(scale_unit: str) -> dict[str, Estimate]:
    """Return the estimates of a leg, each without a value."""
    units = {f'gyro_bias_{axis}': 'rad/s' for axis in 'xyz'} | {
        layout.CONSTANTS[i]: UNITS[layout.CONSTANTS[i]] for i in OPTIONAL}
    return unknown_values(scale_unit) | {
        name: Estimate(None, None, unit) for name, unit in units.items()}


@dataclass(frozen=True, eq=False)
class FittedConstants:
    """Constants from one or several legs."""

    value: Floats           # (M,) ln K first, whole lever arms
    sigma: Floats           # (M,)
    sigma_ratio: Floats     # (M,) sigma of the fit over that of the prior
    factor: float = 1.0     # from model errors, on the sigmas of angles before the comparison
    changed_angles: Collection[str] = ()    # names of angles that change in the leg


def estimate_constants(fitted: FittedConstants, scale_unit: str, nominal: float,
                       config: Config) -> tuple[dict[str, Estimate], list[Reason]]:
    """Return estimates of the constants, and reasons; nominal : configured scale, 0: unknown."""
    value, sigma = fitted.value, fitted.sigma
    is_informed = fitted.sigma_ratio < INFORMED_SHARE
    K, relative = float(np.exp(value[layout.LN_K])), float(sigma[layout.LN_K])
    estimates, reasons = unknown_estimates(scale_unit), list[Reason]()
    if relative <= SCALE_LIMIT:
        estimates['scale_factor'] = Estimate(K, K * relative, scale_unit)
        if nominal:
            estimates['scale_ratio'] = Estimate(K / nominal, K / nominal * relative, '1')
    else:
        reasons.append(Reason(
            Code.SCALE_NOT_DETERMINED, f'scale uncertainty is {100 * relative:.0f} %, too large '
            f'to state a value; the limit is {100 * SCALE_LIMIT:g} %'))
    # sigma above which an angle is not stated
    limit = max(np.deg2rad(0.5), config.verdict.max_yaw_sigma)
    for name, i, angle in (('yaw_mounting_angle', layout.YAW, wrap(value[layout.YAW])),
                           ('pitch_mounting_angle', layout.PITCH, value[layout.PITCH])):
        # a configured mounting angle is not determined by the drive
        if fitted.factor * sigma[i] <= limit and is_informed[i]:
            estimates[name] = Estimate(float(angle), float(sigma[i]), 'rad')
    for i in OPTIONAL:
        if is_informed[i]:
            name = layout.CONSTANTS[i]
            estimates[name] = Estimate(float(value[i]), float(sigma[i]), UNITS[name])
    return estimates, reasons + _angle_reasons(fitted, limit, config)


def configured_constants(leg: SmootherLeg) -> Floats:
    """Return the settings that constants are corrections of: (M,), zero without a setting."""
    value = np.zeros(layout.M)
    value[layout.ODO_ARM], value[layout.GNSS_ARM] = leg.odometer_arm, leg.antenna_arm
    return value


def marginal_information(fit: Fit, setting_values: Floats) -> MarginalInformation:
    """
    Return the marginal information of a fit at its last linearisation point, (S33).

    It is the Schur complement of the constants minus the weights of their priors, and zero for
    constants that are fixed in the leg, or that other legs do not share. A speed offset that the
    leg has selected is information: it holds in all legs.

    setting_values : (M,) as ``configured_constants``.
    """
    constants, priors = fit.weighted.state.constants, fit.weighted[PriorRows].priors
    reduced, g_reduced = fit.solution.reduced, fit.solution.g_reduced
    # LEG_CONSTANTS are eliminated, with their priors
    leg_rows = reduced[layout.LEG_CONSTANTS]
    gain = np.linalg.solve(leg_rows[:, layout.LEG_CONSTANTS], leg_rows).T
    g_reduced = g_reduced - gain @ g_reduced[layout.LEG_CONSTANTS]
    reduced = reduced - gain @ leg_rows
    mean, sigma = fit.initial_priors.mean, priors.sigma.copy()
    sigma[layout.SPEED_OFFSET] = fit.initial_priors.sigma[layout.SPEED_OFFSET]
    weight = 1 / sigma**2
    free = sigma > layout.NO_ERROR
    free[layout.LEG_CONSTANTS] = False
    return MarginalInformation(
        layout.CONSTANTS, constants + setting_values,
        (reduced - np.diag(weight)) * np.outer(free, free),
        (g_reduced + weight * (constants - mean)) * free, mean + setting_values,
        fit.initial_priors.sigma, sigma).with_errors(
            fit.by_levels[:, :-len(SIZES)])     # sizes are of the priors, no data


def not_observable_reason(drives: str, names: list[str], local: bool) -> Reason:
    """
    Return the reason that constants keep their configured values.

    drives : subject, as text.   names : of estimates.   local : positions in a local frame.
    """
    remedy = ('Measure these heights and set them. Even a drive with turns and stops hardly '
              'determines them.' if all(name.endswith('_z') for name in names) else '')
    return Reason(Code.PARAMETER_NOT_DETERMINED, f'not observable on {drives}: '
                  f'{name_antenna(join_names(names), local)}; the configured values are used',
                  remedy)


def join_names(names: Iterable[str]) -> str:
    """Return names of estimates as text, with the axes of one lever arm together."""
    words: dict[str, list[str]] = {}
    for name in names:
        stem, _, axis = name.rpartition('_')
        if axis not in AXIS_NAMES:
            stem, axis = name, ''
        words.setdefault(stem.replace('gnss', 'fix').replace('_', ' '), []).append(
            AXIS_NAMES.get(axis, ''))
    texts = [f'the {word}' + (f' ({", ".join(axes)})' if 0 < len(axes) < 3 and axes[0] else '')
             for word, axes in words.items()]
    return texts[0] if len(texts) == 1 else f'{", ".join(texts[:-1])} and {texts[-1]}'


def _angle_reasons(fitted: FittedConstants, limit: float, config: Config) -> list[Reason]:
    """Return the reasons for mounting angles that are not determined, or far from nominal."""
    sigma, factor, changed_angles = fitted.sigma, fitted.factor, fitted.changed_angles
    yaw, reasons = float(wrap(fitted.value[layout.YAW])), list[Reason]()
    limit_text = (f', including a factor of {factor:.2g} for model errors' * (factor > 1)
                  + f'; the limit is {np.rad2deg(limit):.2g} deg')
    deviation = abs(float(wrap(yaw - nominal_yaw(config))))
    if sigma[layout.YAW] > limit / factor:
        cause = 'see CHANGE_IN_LEG' if layout.CONSTANTS[layout.YAW] in changed_angles else (
            'too little acceleration, or too few turns' if sigma[layout.YAW] > limit else
            'the model errors')
        reasons.append(Reason(Code.YAW_NOT_DETERMINED, 'yaw mounting uncertainty is '
                              f'{differing(*np.rad2deg([factor * sigma[layout.YAW], limit]))} '
                              f'deg{limit_text}. Likely cause: {cause}',
                              OTHER_WARNINGS if sigma[layout.YAW] <= limit else ''))
    elif deviation > REVERSED_YAW:
        reasons.append(Reason(Code.ODOMETER_REVERSED, 'odometer and IMU have opposite '
                              'directions: positive counts mean reverse motion, or the IMU x '
                              f'axis points backwards (yaw {np.rad2deg(yaw):+z.1f} deg)'))
    elif deviation > FAR_YAW:
        reasons.append(Reason(Code.YAW_FAR_FROM_NOMINAL, f'yaw mounting {np.rad2deg(yaw):+z.1f} '
                              f'deg differs by {np.rad2deg(deviation):.1f} deg from its nominal '
                              f'value; the limit is {np.rad2deg(FAR_YAW):.0f} deg'))
    if sigma[layout.PITCH] > limit / factor:
        reasons.append(Reason(
            Code.PITCH_NOT_DETERMINED, 'pitch mounting uncertainty is '
            f'{differing(*np.rad2deg([factor * sigma[layout.PITCH], limit]))} deg{limit_text}',
            'See CHANGE_IN_LEG.' if layout.CONSTANTS[layout.PITCH] in changed_angles else
            OTHER_WARNINGS if sigma[layout.PITCH] <= limit else
            'Drive longer, with stops and starts. Accurate heights, or z of poses, also help.'))
    return reasons
