# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The result of a fit: estimates, reasons, error budget, details (``make_result``).

The error budget, docs/method.md (S32), states the effect of each error source on scale, yaw and
pitch. The result also has the marginal information for other legs, (S33).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.calib.budget import budget_table, correlations, PARAMETERS, root_of
from odocal_ros.calib.evidence import KEPT_ROWS
from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.calib.slip import travel_error_sign, travel_reasons
from odocal_ros.calib.value_limits import check_limits
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.equations import EXTERNAL_FACTORS
from odocal_ros.estimator.factors.factor import PARAMETER_COUNT
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.interval_noise import assumed_noise_reasons
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.pseudo_observations import PriorRows, SIZES
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result import odometry_output, remarks, residuals
from odocal_ros.estimator.result.estimates import (
    configured_constants,
    estimate_constants,
    FittedConstants,
    marginal_information,
    not_observable_reason,
    OPTIONAL,
)
from odocal_ros.estimator.result.mismatch import find_mismatch
from odocal_ros.estimator.result.wheel_result import Wheel, wheel_details, wheel_estimates
from odocal_ros.estimator.result.wheels import fit_wheels
from odocal_ros.reasons import Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import INFORMED_SHARE

# indices of the constants that are errors of IMU, receiver, tyres and body: in the details
IMPERFECTION_CONSTANTS = range(layout.FIX_MOTION_TIME, layout.VELOCITY.start)


@dataclass(frozen=True, eq=False)
class _Posterior:
    """Uncertainty of the constants after the fit, with the errors of the model, (S31)."""

    factor: float        # f of (S31), which multiplies the sigmas of the fit
    covariance: Floats   # (M, M)
    sigma: Floats        # (M,)
    sigma_ratio: Floats  # (M,) sigma of the fit over that of the prior
    beyond_fit: list[remarks.ErrorBeyondFit]


def make_result(leg: SmootherLeg, problem: Problem, fit: Fit, config: Config) -> MethodResult:
    """Return the result of a fit; ``fit.solution`` cannot be used afterwards."""
    marginals = fit.solution.marginals()
    factor, reasons = find_mismatch(problem, fit, config)
    # only the steps of a coarse speed are used, which do not show slip
    slips: tuple[residuals.Slip, ...] = ()
    unexplained = None
    if not leg.uses_speed_steps:
        slip_path = residuals.odometer_minus_ground_path(fit, marginals)
        slips = residuals.find_slips(fit, slip_path, leg.travel.quantum * fit.state.scale)
        unexplained = residuals.find_unexplained_travel(fit, slip_path)
    posterior = _posterior(problem, fit, factor, slips, unexplained)
    sigma, grade = posterior.sigma, problem.grade if leg.has_accelerometer else None
    reasons += [unexplained.reason()] if unexplained else []
    reasons += _slip_reasons(leg, fit, marginals, slips, sigma)
    reasons += remarks.remarks(problem, fit, sigma, posterior.sigma_ratio, config)
    estimates, refusals = _estimate(leg, fit, posterior, config)
    wheels = _fit_wheels(problem, fit, marginals, posterior, config)
    additional, wheel_reasons = wheel_estimates(
        [wheel.name for wheel in leg.wheels], wheels, estimates['scale_factor'],
        config) if leg.wheels else ({}, [])
    gyro_bias, bias_ratio = _estimate_gyro_bias(fit, marginals, factor)
    estimates |= additional | gyro_bias
    ratio = {layout.CONSTANTS[i]: float(posterior.sigma_ratio[i])
             for i in (*OPTIONAL, *IMPERFECTION_CONSTANTS)} | bias_ratio
    reasons += [*refusals, *wheel_reasons,
                *_not_observable_reasons(problem, fit, sigma, ratio, estimates)]
    reasons += assumed_noise_reasons(problem, fit.levels)
    reasons += check_limits(estimates, leg.nominal_scale, config)
    sources, information = _budget(leg, fit, marginals, posterior)
    details = _details(leg, problem, fit, sources, ratio, factor, sigma)
    details |= residuals.stored_residuals(leg, problem, fit) | wheel_details(wheels)
    details |= odometry_output.odometry_details(leg, problem, fit, marginals, factor)
    details |= {'key_bias_sigmas': residuals.bias_sigmas(marginals, factor),
                'slips': [vars(slip) for slip in slips],
                'beside': odometry_output.additional_figures(
                    fit.state.constants, posterior.covariance, grade)}
    if grade is not None:
        details['level_pitch_angle'] = odometry_output.level_pitch(fit, marginals, factor)
    return MethodResult('smoother', tuple(reasons), estimates, PARAMETERS, tuple(sources), details,
                        information)


def _posterior(problem: Problem, fit: Fit, factor: float, slips: tuple[residuals.Slip, ...],
               unexplained: residuals.UnexplainedTravel | None) -> _Posterior:
    """Return covariance and sigmas of the constants, the errors beyond the fit included."""
    covariance = with_model_floor(fit.covariance * factor**2)
    travel_errors = {}
    if slips:
        slip = abs(sum(slip.metres for slip in slips))
        travel_errors['slip'] = slip / residuals.path_length(fit)
    if unexplained:
        travel_errors['unexplained_travel'] = unexplained.error
    beyond_fit = remarks.find_errors_beyond_fit(problem, fit, np.sqrt(np.diag(covariance)),
                                                travel_errors)
    for error in beyond_fit:
        covariance[error.constant, error.constant] += error.sigma**2
    return _Posterior(factor, covariance, np.sqrt(np.diag(covariance)),
                      np.sqrt(np.diag(fit.covariance)) / fit.priors.sigma, beyond_fit)


def _estimate(leg: SmootherLeg, fit: Fit, posterior: _Posterior,
              config: Config) -> tuple[dict[str, Estimate], list[Reason]]:
    """Return the estimates of the constants, and the reasons for those not determined."""
    changed_angles = {layout.CONSTANTS[error.constant] for error in posterior.beyond_fit
                      if error.constant != layout.LN_K}
    fitted = FittedConstants(fit.state.constants + configured_constants(leg), posterior.sigma,
                             posterior.sigma_ratio, posterior.factor, changed_angles)
    estimates, reasons = estimate_constants(fitted, leg.scale_unit, leg.nominal_scale, config)
    if estimates['scale_factor'].value is not None:
        estimates |= odometry_output.raw_scale(leg, fit.state, posterior.covariance)
    return estimates, reasons


def _fit_wheels(problem: Problem, fit: Fit, marginals: JointMarginals, posterior: _Posterior,
                config: Config) -> dict[str, Wheel]:
    """Return the wheels relative to their mean, by name."""
    up_b = fit.state.C_bv[:, 2]
    drift = float(np.sqrt(up_b @ marginals[0][layout.BG, layout.BG] @ up_b) * posterior.factor)
    return fit_wheels(problem, fit, posterior.covariance, drift, config.odometer.track_width)


def _estimate_gyro_bias(fit: Fit, marginals: JointMarginals,
                        factor: float) -> tuple[dict[str, Estimate], dict[str, float]]:
    """Return the estimates of the first gyro bias, and ratios of sigma to prior, by name."""
    sigma = np.sqrt(np.diagonal(marginals[0])[layout.BG]) * factor
    ratio = sigma / fit.initial_priors.gyro_bias_sigma
    names = [f'gyro_bias_{axis}' for axis in 'xyz']
    return {name: Estimate(float(fit.state.gyro_bias[0, i]), float(sigma[i]), 'rad/s')
            for i, name in enumerate(names) if ratio[i] < INFORMED_SHARE}, dict(
                zip(names, ratio.tolist(), strict=True))


def _not_observable_reasons(problem: Problem, fit: Fit, sigma: Floats, ratio: Mapping[str, float],
                      estimates: Mapping[str, Estimate]) -> list[Reason]:
    """Return the reason for constants without an estimate, but those of LEVER_ARM_OFF."""
    reported = {layout.CONSTANTS[i]
                for i in remarks.deviating_lever_arms(fit.state.constants, sigma)}
    names = [name for name in ratio if name in estimates and estimates[name].value is None
             and name not in reported]
    return [not_observable_reason('this drive', names, problem.leg.origin.is_local)] \
        if names else []


def _budget(leg: SmootherLeg, fit: Fit, marginals: JointMarginals,
            posterior: _Posterior) -> tuple[list[Source], MarginalInformation]:
    """Return the error sources, and the information for other legs, both with model errors."""
    sources = [*(replace(source, effects=source.effects * posterior.factor)
                 for source in error_sources(fit, marginals)),
               Source('model', np.diag(remarks.MODEL_FLOOR))]
    information = marginal_information(fit, configured_constants(leg)).widened(posterior.factor)
    for error in posterior.beyond_fit:
        shared = error.source == 'height'      # unknown on one road as on the next
        sources.append(Source(error.source, error.sigma
                              * np.eye(PARAMETER_COUNT)[:, [error.constant]], shared))
        if not shared:
            information = information.with_leg_errors(
                {layout.CONSTANTS[error.constant]: error.sigma})
    return sources, information


def _slip_reasons(leg: SmootherLeg, fit: Fit, marginals: JointMarginals,
                  slips: tuple[residuals.Slip, ...], sigma: Floats) -> list[Reason]:
    """Return the reasons that report slips, lost or added travel, and a filter."""
    filtered = remarks.filter_reasons(fit.state.constants[layout.ODO_LAG2], sigma[layout.ODO_LAG2])
    if leg.uses_speed_steps:
        return list(filtered)
    speed = np.einsum('ni,nij,j->n', fit.state.v_n, fit.state.C_nb, fit.state.forward)
    # 0: slip; else no force explains it: the odometer lost (-1) or added (1) the travel
    sign = np.array([travel_error_sign(s.t, s.duration, s.metres, fit.state.t, speed)
                     for s in slips], int)
    # a filter of unknown shape, or a late or held speed, also has errors at changes of speed
    level = '' if filtered or (sign > 0).any() else residuals.describe_slip_level(
        fit, marginals, leg.travel.quantum * fit.state.scale)
    wheel_slips = tuple(slip for slip, s in zip(slips, sign, strict=True) if s == 0)
    return [*filtered, *residuals.slip_reasons(wheel_slips, level), *travel_reasons(
        np.array([s.t for s in slips]), np.array([s.metres for s in slips]), sign)]


def with_model_floor(covariance: Floats) -> Floats:
    """Return the covariance plus the lower limit F^2 of model errors: docs/method.md (S31)."""
    covariance, parameters = covariance.copy(), range(len(remarks.MODEL_FLOOR))
    covariance[parameters, parameters] += remarks.MODEL_FLOOR**2
    return covariance


def _details(leg: SmootherLeg, problem: Problem, fit: Fit, sources: list[Source],
             ratio: dict[str, float], factor: float, sigma: Floats) -> dict[str, Any]:
    """Return the details of the result by the keys of calibration.json; sigma : (M,)."""
    state, motion, fixes = fit.state, fit.weighted[MotionRows].motion, fit.weighted[Fixes]
    K = state.scale
    arm = state.C_bv @ motion.arm_v
    step = max(1, len(state.t) // KEPT_ROWS)
    t_fix = leg.t_fix[problem.used_fixes]
    speed = np.linalg.norm(motion.displacement, axis=1) / motion.T[:, 0]
    return {
        'budget': budget_table(sources, PARAMETERS, (K, 1.0, 1.0)),
        'correlation': correlations(fit.covariance[:3, :3], PARAMETERS),
        'f': K * state.forward, 'C_bv': state.C_bv, 'noise': fit.levels.sigmas(),
        'iterations': fit.iterations, 'widened': float(factor),
        'external': _external_details(problem, fit, sigma), 'posterior_to_prior': ratio,
        **{layout.CONSTANTS[i]: {'value': float(state.constants[i]), 'sigma': float(sigma[i])}
           for i in IMPERFECTION_CONSTANTS},
        'residuals': {'fix_rms_in_sigmas': float(np.sqrt((fixes.r[:, :2]**2).mean())),
                      'fix_correlation_2s': residuals.correlation(t_fix, fixes.r[:, :2]),
                      'fixes_downweighted': int((fixes.weight[:, 0] < 0.5).sum()),
                      'fixes': len(t_fix), 'normalised': residuals.normalised_residuals(
                          fit.weighted),
                      'intervals_slipping': int(
                          (fit.variance_factors[:, 0] > residuals.SLIP_VARIANCE).sum())},
        'excitation': {'distance': residuals.path_length(fit),
                       'speed_changes': float(np.abs(np.diff(speed)).sum()),
                       'turned': float((motion.turning * motion.T[:, 0]).sum()),
                       'in_turns': problem.total_turn, 'standing': float(problem.at_rest.sum())},
        'track_t': state.t[::step], 'track_n': (state.p_n + state.C_nb @ arm)[::step],
        'key_t': state.t, 'key_C_nb': state.C_nb, 'gyro_bias': state.gyro_bias.mean(axis=0),
        'key_biases': np.stack([state.gyro_bias, state.accel_bias])}


def _external_details(problem: Problem, fit: Fit, sigma: Floats) -> dict[str, dict[str, Any]]:
    """Return details of the sensors besides IMU, odometer and fixes."""
    return {kind.name: {'messages': len(samples.t),
                        'rows_per_independent': problem.rows_per_independent.get(kind.name, 1.0),
                        **kind.details(samples, fit.state.constants, sigma)}
            for kind in EXTERNAL_FACTORS
            if (samples := problem.external.get(kind.name)) is not None}


def error_sources(fit: Fit, marginals: JointMarginals) -> tuple[Source, ...]:
    """Return the error sources of ln K, yaw and pitch, (S32); the rest is that of standstills."""
    solution = fit.solution.covariance
    covariance: dict[str, np.ndarray] = {}
    for factor in fit.weighted.factors.values():
        for name, effects in factor.effects(marginals):
            # (..., 3, k) to (3, all unit errors)
            columns = np.moveaxis(effects, -2, 0).reshape(PARAMETER_COUNT, -1)
            covariance[name] = covariance.get(name, 0.0) + columns @ columns.T
    shared = [Source(name, effects, True)
              for name, effects in fit.weighted[PriorRows].shared_effects(solution)]
    rest = solution[:PARAMETER_COUNT, :PARAMETER_COUNT] - sum(covariance.values()) - sum(
        s.effects @ s.effects.T for s in shared)
    by_levels = fit.by_levels[:PARAMETER_COUNT]
    for name, effects in (('noise_levels', by_levels[:, :-len(SIZES)]),
                          ('imperfection_sizes', by_levels[:, -len(SIZES):])):
        covariance[name] = effects @ effects.T
    sources = [Source(name, root_of(value)) for name, value in covariance.items()]
    return (*sources, *shared, Source('standstill', root_of(rest)))
