# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoother's fit as a method's result: estimates, reasons, budget, statistics of the drive."""

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.calib.budget import budget_table, correlations, PARAMETERS
from odocal_ros.calib.evidence import KEPT_ROWS
from odocal_ros.calib.judge import judge
from odocal_ros.calib.mounting import FAR_YAW
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.calib.slip import travel_reasons, unforced
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.equations import OUTSIDE
from odocal_ros.estimator.factors.factor import WANTED
from odocal_ros.estimator.factors.fixes import Fixes
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.slide import assumed
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result import remarks, slip
from odocal_ros.estimator.result.border import border_of, shares
from odocal_ros.estimator.result.exported import as_sent, exported
from odocal_ros.estimator.result.filters import filter_reasons
from odocal_ros.estimator.result.left_over import bias_sigmas, correlation, left_over, normalised
from odocal_ros.estimator.result.mismatch import mismatch
from odocal_ros.estimator.result.refusal import OPTIONAL, UNITS, unknown
from odocal_ros.estimator.result.wheel_result import wheel_details, wheel_estimates
from odocal_ros.estimator.result.wheels import wheels_beside
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import INFORMED_SHARE, SCALE_LIMIT
from odocal_ros.settings.nominal import nominal_yaw

AXES = {'x': 'forward', 'y': 'left', 'z': 'up'}
SCALES = range(layout.FIX_TIME, layout.VELOCITY.start)    # errors of IMU, receiver, tyres, body


def outcome(leg: SmootherLeg, problem: Problem, fit: Fit, config: Config) -> MethodResult:
    """Return the result of a fit: estimates, reasons, budget, details."""
    near = fit.solved.marginals()
    widen, reasons = mismatch(problem, fit, config)
    count = leg.travel.quantum * fit.state.scale
    state, c = fit.state, fit.state.constants
    covariance = floored(fit.covariance * widen**2)
    beyond = remarks.beyond_fit(problem, fit, np.sqrt(np.diag(covariance)))
    for i, _, own in beyond:
        covariance[i, i] += own**2
    sigma = np.sqrt(np.diag(covariance))
    filtered = filter_reasons(c[layout.ODO_LAG2], sigma[layout.ODO_LAG2])
    slips, slip_said = _slips(leg, fit, near, count, filtered=bool(filtered))
    reasons += [*filtered, *slip_said]
    after = np.sqrt(np.diag(fit.covariance)) / fit.priors.constants
    reasons += remarks.remarks(problem, fit, sigma, after, config)
    ratio = {layout.CONSTANTS[i]: float(after[i]) for i in (*OPTIONAL, *SCALES)}
    found, undetermined = determined(c + configured(leg), sigma, after, leg.scale_unit,
                                     leg.nominal_scale, config, widen, {
                                         layout.CONSTANTS[i] for i, _, _ in beyond
                                         if i != layout.LN_K})
    reasons += undetermined
    if found['scale_factor'].value is not None:
        found |= as_sent(leg, state, covariance)
    up_b = state.C_bv[:, 2]
    drift = float(np.sqrt(up_b @ near[0][layout.BG, layout.BG] @ up_b) * widen)
    wheels = wheels_beside(problem, fit, covariance, drift, config.odometer.track_width)
    if leg.wheels:
        of_wheels, why = wheel_estimates(
            [wheel.name for wheel in leg.wheels], wheels, found['scale_factor'], config)
        found, reasons = found | of_wheels, reasons + why
    bias_sigma = np.sqrt(np.diagonal(near[0])[layout.BG]) * widen
    for i, axis in enumerate('xyz'):
        name = f'gyro_bias_{axis}'
        ratio[name] = float(bias_sigma[i] / fit.first.gyro_bias[i])
        if ratio[name] < INFORMED_SHARE:
            found[name] = Estimate(float(state.gyro_bias[0, i]), float(bias_sigma[i]), 'rad/s')
    said = {layout.CONSTANTS[i] for i in remarks.arms_off(c, sigma)}      # by LEVER_ARM_OFF
    unsaid = [name for name in ratio if name in found and found[name].value is None
              and name not in said]
    if unsaid:
        reasons.append(not_observable('this drive', unsaid))
    reasons += assumed(problem, fit.levels)
    reasons += judge(found, leg.nominal_scale, config)
    sources = [*(replace(s, effects=s.effects * widen) for s in shares(fit, near)),
               Source('model', np.diag(remarks.MODEL_FLOOR))]
    border = border_of(fit, configured(leg)).widened(widen)
    for i, name, own in beyond:
        shared = name == 'height'      # unknown on one road as on the next
        sources.append(Source(name, own * np.eye(WANTED)[:, [i]], shared))
        if not shared:
            border = border.loosened({layout.CONSTANTS[i]: own})
    grade = problem.grade if leg.has_accelerometer else None
    return MethodResult('smoother', tuple(reasons), found, PARAMETERS, tuple(sources),
                        _details(leg, problem, fit, sources, ratio, widen, sigma)
                        | left_over(leg, problem, fit) | wheel_details(wheels)
                        | exported(leg, problem, fit, near, widen)
                        | {'key_bias_sigmas': bias_sigmas(near, widen),
                           'slips': [vars(s) for s in slips],
                           'beside': remarks.beside(c, covariance, grade)}
                        | ({} if grade is None else {
                            'level_pitch_angle': remarks.level_pitch(fit, near, widen)}),
                        border)


def _slips(leg: SmootherLeg, fit: Fit, near: JointMarginals, count: float, *,
           filtered: bool) -> tuple[tuple[slip.Slip, ...], list[Reason]]:
    """Return the slips, and the reasons that report them."""
    if leg.by_steps:    # only the steps of a coarse speed are used, which do not show slip
        return (), []
    turned = slip.along(fit, near)
    slips = slip.find_slips(fit, turned, count)
    speed = np.einsum('ni,nij,j->n', fit.state.v_n, fit.state.C_nb, fit.state.forward)
    sign = np.array([unforced(s.t, s.duration, s.metres, fit.state.t, speed) for s in slips], int)
    # the shape of a filter is unknown, and a late or held speed errs at changes of speed: no slip
    level = '' if filtered or (sign > 0).any() else slip.level_when_changing(fit, near, count)
    slid = tuple(s for s, of in zip(slips, sign, strict=True) if not of)
    return slips, [*slip.slip_reasons(slid, level), *travel_reasons(
        np.array([s.t for s in slips]), np.array([s.metres for s in slips]), sign)]


def floored(covariance: Floats) -> Floats:
    """Return the covariance with the floor of the model: docs/method.md (S31)."""
    covariance, at = covariance.copy(), range(len(remarks.MODEL_FLOOR))
    covariance[at, at] += remarks.MODEL_FLOOR**2
    return covariance


def determined(value: Floats, sigma: Floats, ratio: Floats, scale_unit: str, nominal: float,
               config: Config, doubt: float = 1.0, moved: Collection[str] = ()
               ) -> tuple[dict[str, Estimate], list[Reason]]:
    """
    Return the estimates of the constants, and the reasons for those that are not determined.

    value, sigma : (M,) of the constants, ln K first, whole lever arms.   ratio : (M,) posterior
    sigma by that of the prior.   scale_unit, nominal : of the scale; K0, 0 unknown.   config :
    limits.   doubt : factor on the sigmas by model errors; angles must be determined with it.
    moved : angles that change in the leg.
    """
    K, yaw = float(np.exp(value[layout.LN_K])), float(wrap(value[layout.YAW]))
    pitch = float(value[layout.PITCH])
    found = unknown(scale_unit)
    if sigma[layout.LN_K] <= SCALE_LIMIT:
        found['scale_factor'] = Estimate(K, float(K * sigma[layout.LN_K]), scale_unit)
        if nominal:
            found['scale_ratio'] = Estimate(K / nominal,
                                            float(K / nominal * sigma[layout.LN_K]), '1')
    # an angle with a larger sigma than half a degree and the limit is not determined
    limit = max(np.deg2rad(0.5), config.verdict.max_yaw_sigma)
    for name, i, angle in (('yaw_mounting_angle', layout.YAW, yaw),
                           ('pitch_mounting_angle', layout.PITCH, pitch)):
        # a configured mounting angle is not determined by the drive
        if doubt * sigma[i] <= limit and ratio[i] < INFORMED_SHARE:
            found[name] = Estimate(angle, float(sigma[i]), 'rad')
    for i in OPTIONAL:
        if ratio[i] < INFORMED_SHARE:
            name = layout.CONSTANTS[i]
            found[name] = Estimate(float(value[i]), float(sigma[i]), UNITS[name])
    return found, _undetermined(sigma, limit, doubt, config, yaw, moved)


def configured(leg: SmootherLeg) -> Floats:
    """Return the values of the settings that constants are corrections to: (M,)."""
    value = np.zeros(layout.M)
    value[layout.ODO_ARM], value[layout.GNSS_ARM] = leg.odometer_arm, leg.antenna_arm
    return value


def not_observable(drives: str, names: list[str]) -> Reason:
    """Return the reason that constants keep their configured values; names: of estimates."""
    heights = all(name.endswith('_z') for name in names)
    return Reason(Code.PARAMETER_NOT_DETERMINED, f'not observable on {drives}: '
                  f'{in_words(names)}; the configured values are used',
                  'Measure these heights and set them: turns, stops and starts hardly determine '
                  'them.' if heights else '')


def in_words(names: Iterable[str]) -> str:
    """Return names of estimates as people say them, axes of one thing together."""
    words: dict[str, list[str]] = {}
    for name in names:
        stem, _, axis = name.rpartition('_')
        if axis not in AXES:
            stem, axis = name, ''
        words.setdefault(stem.replace('gnss', 'fix').replace('_', ' '), []).append(
            AXES.get(axis, ''))
    said = [f'the {word}' + (f' ({", ".join(axes)})' if 0 < len(axes) < 3 and axes[0] else '')
            for word, axes in words.items()]
    return said[0] if len(said) == 1 else f'{", ".join(said[:-1])} and {said[-1]}'


def _undetermined(sigma: Floats, usual: float, doubt: float, config: Config, yaw: float,
                  moved: Collection[str]) -> list[Reason]:
    limit = usual / doubt
    reasons, wanted = [], f'; the limit is {np.rad2deg(limit):.2g} deg'
    if doubt > 1:
        wanted += f' ({np.rad2deg(usual):.2g} deg / {doubt:.2g}, the factor on uncertainties)'
    if sigma[layout.LN_K] > SCALE_LIMIT:
        reasons.append(Reason(Code.SCALE_NOT_DETERMINED, 'scale uncertainty is '
                              f'{100 * sigma[layout.LN_K]:.0f} %, too large to state a value; the '
                              f'limit is {100 * SCALE_LIMIT:g} %'))
    off = abs(float(wrap(yaw - nominal_yaw(config))))
    if sigma[layout.YAW] > limit:
        cause = 'see CHANGE_IN_LEG' if layout.CONSTANTS[layout.YAW] in moved else (
            'too little acceleration, or too few turns')
        reasons.append(Reason(Code.YAW_NOT_DETERMINED, 'yaw mounting uncertainty is '
                              f'{np.rad2deg(sigma[layout.YAW]):.2f} deg{wanted}. '
                              f'Likely cause: {cause}'))
    elif off > np.deg2rad(135.0):       # more than any mounting: reversed
        reasons.append(Reason(Code.ODOMETER_REVERSED, 'odometer and IMU have opposite '
                              'directions: positive counts mean backwards, or the IMU x axis '
                              f'points backwards (yaw {np.rad2deg(yaw):+z.1f} deg)'))
    elif off > FAR_YAW:
        reasons.append(Reason(Code.YAW_FAR_FROM_NOMINAL, f'yaw mounting {np.rad2deg(yaw):+z.1f} '
                              f'deg differs by {np.rad2deg(off):.1f} deg from its nominal value; '
                              f'the limit is {np.rad2deg(FAR_YAW):.0f} deg'))
    if sigma[layout.PITCH] > limit:
        reasons.append(Reason(Code.PITCH_NOT_DETERMINED, 'pitch mounting uncertainty is '
                              f'{np.rad2deg(sigma[layout.PITCH]):.2f} deg{wanted}',
                              'See CHANGE_IN_LEG.' if layout.CONSTANTS[layout.PITCH] in moved else
                              'Drive longer, with stops and starts. Accurate ellipsoidal heights '
                              'also help.'))
    return reasons


def _details(leg: SmootherLeg, problem: Problem, fit: Fit, sources: list[Source],
             ratio: dict[str, float], widen: float,
             sigma: Floats) -> dict[str, Any]:
    state, motion, fixes = fit.state, fit.weighted[MotionRows].motion, fit.weighted[Fixes]
    K = state.scale
    arm = state.C_bv @ motion.arm_v
    step = max(1, len(state.t) // KEPT_ROWS)
    t_fix = leg.t_fix[problem.use]
    speed = np.linalg.norm(motion.displacement, axis=1) / motion.T[:, 0]
    return {
        'budget': budget_table(sources, PARAMETERS, (K, 1.0, 1.0)),
        'correlation': correlations(fit.covariance[:3, :3], PARAMETERS),
        'f': K * state.forward,
        'noise': fit.levels.roots(),
        'iterations': fit.iterations, 'widened': float(widen),
        'outside': _outside(problem, fit, sigma),
        'posterior_to_prior': ratio,
        **{layout.CONSTANTS[i]: {'value': float(state.constants[i]), 'sigma': float(sigma[i])}
           for i in SCALES},
        'residuals': {'fix_rms_in_sigmas': float(np.sqrt((fixes.r[:, :2]**2).mean())),
                      'fix_correlation_2s': correlation(t_fix, fixes.r[:, :2]),
                      'fixes_downweighted': int((fixes.weight[:, 0] < 0.5).sum()),
                      'fixes': len(t_fix), 'normalised': normalised(fit.weighted),
                      'intervals_slipping': int((fit.spread[:, 0] > slip.SLIP_VARIANCE).sum())},
        'excitation': {'distance': float(np.linalg.norm(motion.displacement, axis=1).sum()),
                       'speed_changes': float(np.abs(np.diff(speed)).sum()),
                       'turned': float((motion.turning * motion.T[:, 0]).sum()),
                       'in_turns': problem.turned,
                       'standing': float(problem.still.sum())},
        'track_t': state.t[::step], 'track_n': (state.p_n + state.C_nb @ arm)[::step],
        'key_t': state.t, 'key_C_nb': state.C_nb, 'gyro_bias': state.gyro_bias.mean(axis=0),
        'key_biases': np.stack([state.gyro_bias, state.accel_bias]),
    }


def _outside(problem: Problem, fit: Fit, sigma: Floats) -> dict[str, dict[str, Any]]:
    """Return details of the sensors besides IMU, odometer and fixes."""
    return {part.name: {'messages': len(sent.t),
                        'alike': problem.per_effective.get(part.name, 1.0),
                        **part.details(sent, fit.state.constants, sigma)}
            for part in OUTSIDE if (sent := problem.outside.get(part.name)) is not None}
