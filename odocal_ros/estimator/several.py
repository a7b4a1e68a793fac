# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The result of several legs of one vehicle, from the joint estimate of their marginals."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.calib.budget import budget_table, correlations, PARAMETERS, root_of
from odocal_ros.calib.combine import last_leg_values
from odocal_ros.calib.joint import fit_jointly, FREE_STEP, JointEstimate, scale_steps, ScaleStep
from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.calib.number_text import format_change
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.calib.value_limits import cause_of_change
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.estimator.factors.factor import PARAMETER_COUNT
from odocal_ros.estimator.factors.pseudo_observations import SHARED, SIZE
from odocal_ros.estimator.result import wheel_result
from odocal_ros.estimator.result.estimates import (
    estimate_constants,
    FittedConstants,
    not_observable_reason,
    OPTIONAL,
)
from odocal_ros.estimator.result.odometry_output import additional_figures, combine_raw_scales
from odocal_ros.estimator.result.outcome import IMPERFECTION_CONSTANTS, with_model_floor
from odocal_ros.estimator.result.remarks import MODEL_FLOOR
from odocal_ros.estimator.state import CONSTANTS, IMPERFECTIONS, LN_K, PITCH
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import DAY_NS, FAULT_SIGMAS, REMARK_SIGMAS
from odocal_ros.settings.nominal import grade_of

# usual scatter of ln K, yaw and pitch between the legs of a vehicle: 20 ppm from tyres, 2 and 5
# mdeg from load and the cross slopes of roads. Judgement
SCATTER = 2e-5, 3.5e-5, 8.7e-5
DELAY_REMEDY = ('A delay changed between the legs, not the vehicle. Check the clocks and the '
                'time stamps of this sensor: driver restarts, buffering, clock synchronisation.')


def combine_legs(results: Sequence[MethodResult], times_ns: Sequence[int], config: Config,
                 numbers: Sequence[int] | None = None, local: bool = False) -> MethodResult:
    """
    Return the result of one fit of all legs of one vehicle, the scale as in the last leg.

    results : each with ``marginal``, at least one.   times_ns : of each leg, ns since 1970.
    config : limits, ``verdict.scale_drift_per_day``.   numbers : of the legs in reasons, by
    default 1, 2, ...; 0: legs of an earlier result.   local : positions in a local frame.

    A value that no leg determines alone may be determined by all. If the legs disagree, the sigma
    includes their scatter (LEGS_DISAGREE). With ``leg.automatic`` a scale may change permanently
    between two legs (SCALE_CHANGED).
    """
    by_time = np.argsort(times_ns, kind='stable')
    legs, times = [results[i] for i in by_time], np.asarray(times_ns)[by_time]
    leg_numbers = [(numbers or range(1, len(results) + 1))[i] for i in by_time]
    joint, changes = _fit(legs, times, config)
    order = [joint.names.index(name) for name in CONSTANTS]
    common = _common_sources(legs)
    C = with_model_floor(joint.covariance[np.ix_(order, order)])
    C[:PARAMETER_COUNT, :PARAMETER_COUNT] += sum(s.effects @ s.effects.T for s in common)
    sigma = np.sqrt(np.diag(C))
    fitted = FittedConstants(joint.value[order], sigma,
                             sigma / joint.factor / joint.prior_sigma[order])
    wheels = wheel_result.combine_wheels(legs)
    estimates, refusals = _estimate(legs, fitted, wheels, config, local)
    sources = _error_sources(joint.relaxed_sigma[order] * joint.factor, C, common)
    # a pitch without a prior: some leg has an accelerometer
    grade = grade_of(config.imu) if np.isinf(joint.prior_sigma[order][PITCH]) else None
    details = _details(joint, fitted.value, C, sources, len(legs)) | {
        'beside': additional_figures(fitted.value, C, grade)} | wheel_result.wheel_details(wheels)
    reasons = (*(_scale_change_reason(change, times, leg_numbers) for change in changes),
               *_disagreement_reasons(joint, leg_numbers), *refusals)
    return MethodResult('smoother', reasons, estimates, PARAMETERS, sources, details,
                        joint.information)


def _fit(legs: Sequence[MethodResult], times_ns: Ints,
         config: Config) -> tuple[JointEstimate, list[ScaleStep]]:
    """Return the joint estimate of legs in order of time, and permanent changes of the scale."""
    days = np.diff(times_ns) / DAY_NS
    marginals = _share_sizes([leg.marginal for leg in legs if leg.marginal])     # each has it
    scale, *angles = parameters = CONSTANTS[:PARAMETER_COUNT]
    steps = config.verdict.scale_drift_per_day * np.sqrt(days)
    changes = scale_steps(marginals, steps, scale, angles) if config.leg.automatic else []
    steps[[change.leg - 1 for change in changes]] = FREE_STEP
    usual = dict(zip(parameters, SCATTER, strict=True))
    return fit_jointly(marginals, steps, scale, angles, parameters, usual,
                       (days == 0).tolist()), changes


def _estimate(legs: Sequence[MethodResult], fitted: FittedConstants,
              wheels: dict[str, wheel_result.Wheel], config: Config, local: bool
              ) -> tuple[dict[str, Estimate], list[Reason]]:
    """Return the estimates of the legs together, and the reasons for those not determined."""
    scales = ((leg.estimates[name].value for name in ('scale_factor', 'scale_ratio'))
              for leg in legs)
    nominal = next((K / ratio for K, ratio in scales if K and ratio), 0.0)
    estimates, refusals = estimate_constants(fitted, legs[-1].estimates['scale_factor'].unit,
                                             nominal, config)
    estimates |= combine_raw_scales(legs, estimates['scale_factor'])
    if wheels:
        wheel_estimates, reasons = wheel_result.wheel_estimates(
            list(wheels), wheels, estimates['scale_factor'], config)
        estimates, refusals = estimates | wheel_estimates, refusals + reasons
    estimates |= last_leg_values(
        legs, {n: e for n, e in estimates.items() if not n.startswith('gyro_')})
    undetermined = [CONSTANTS[i] for i in OPTIONAL if estimates[CONSTANTS[i]].value is None]
    if undetermined:
        refusals.append(not_observable_reason(f'these {len(legs)} drives', undetermined, local))
    return estimates, refusals


def _share_sizes(marginals: Sequence[MarginalInformation]) -> list[MarginalInformation]:
    """Return marginals with equal sigmas of the imperfections: means weighted by information."""
    imperfect = set(CONSTANTS[IMPERFECTIONS])
    weighted_logs: dict[str, list[tuple[float, float]]] = {}      # of the sigmas, with weights
    for marginal in marginals:
        prior = 1 / marginal.relaxed_sigma**2
        data = 1 / np.diag(np.linalg.inv(marginal.information + np.diag(prior))) - prior
        share = data / (data + 1 / (SIZE * marginal.prior_sigma**2))        # docs/method.md (S29)
        for name, sigma, weight in zip(marginal.names, marginal.relaxed_sigma, share, strict=True):
            if name in imperfect:
                weighted_logs.setdefault(name, []).append((np.log(sigma), max(weight, 1e-9)))
    means = {}
    for name, pairs in weighted_logs.items():
        log, weight = np.transpose(pairs)
        means[name] = float(np.exp(np.average(log, weights=weight)))
    return [replace(x, relaxed_sigma=np.array([means.get(name, sigma) for name, sigma in zip(
        x.names, x.relaxed_sigma, strict=True)])) for x in marginals]


def _scale_change_reason(change: ScaleStep, times_ns: Ints, numbers: list[int]) -> Reason:
    """Return the reason for a scale that changed between two legs: size, time, likely cause."""
    relative = float(np.expm1(change.change))
    since = str(np.datetime64(int(times_ns[change.leg - 1]), 'ns').astype('datetime64[m]'))
    return Reason(Code.SCALE_CHANGED, f'the scale changed by {format_change(relative)} '
                  f'({abs(change.sigmas):.1f} sigma) since {since.replace("T", " ")} UTC, seen '
                  f'in {_leg_name(numbers[change.leg])}: {cause_of_change(relative)}')


def _leg_name(number: int) -> str:
    return f'leg {number}' if number else 'the saved result'


def _disagreement_reasons(joint: JointEstimate, numbers: list[int]) -> tuple[Reason, ...]:
    """Return the reasons for constants in which legs differ, with the leg that differs most."""
    J, reasons = len(joint.deviation), list[Reason]()      # J : number of legs
    unexplained = {name: joint.deviation[:, joint.names.index(name)] for name in joint.differing}
    # parameters correlated with such a constant differ as well
    worst = max((np.abs(z).max() for n, z in unexplained.items() if n in PARAMETERS), default=0.0)
    for name, z in unexplained.items():
        k = int(np.argmax(np.abs(z)))
        if name not in PARAMETERS and abs(z[k]) < max(FAULT_SIGMAS, worst):
            continue
        # two legs have the same deviation from each other
        largest = (f'; {_leg_name(numbers[k])} differs most: {z[k]:+z.1f} sigma from the value of '
                   'all legs') * (J > 2)
        reasons.append(Reason(
            Code.LEGS_DISAGREE, f'{name}: the scatter of {J} legs is {np.sqrt((z**2).mean()):.1f} '
            f'times their uncertainties{largest}', DELAY_REMEDY if 'delay' in name else ''))
    if joint.factor > 1:
        in_others = ' in all parameters but scale, yaw and pitch' * bool(joint.scatter)
        reasons.append(Reason(
            Code.LEGS_DISAGREE, f'the scatter of {J} legs{in_others} is {joint.factor:.1f} times '
            f'their uncertainties; {_largest_deviation(joint, numbers)}'))
    return tuple(reasons)


def _largest_deviation(joint: JointEstimate, numbers: list[int]) -> str:
    """Return the largest deviation of a constant without scatter between legs, as text."""
    constants = [i for i, name in enumerate(joint.names) if name not in joint.scatter]
    z = joint.deviation[:, constants]
    j, i = np.unravel_index(np.argmax(np.abs(z)), z.shape)
    # two legs have the same deviation from each other
    of_leg = f' of {_leg_name(numbers[j])}' * (len(z) > 2)
    text = f'{joint.names[constants[i]]}{of_leg} differs most ({abs(z[j, i]):.1f} sigma)'
    return text if abs(z[j, i]) > REMARK_SIGMAS else f'no parameter alone explains it: {text}'


def _common_sources(legs: Sequence[MethodResult]) -> list[Source]:
    """Return errors beyond the fits that all legs share: the largest of each source."""
    largest: dict[str, Source] = {}
    for source in (s for leg in legs for s in leg.sources if s.shared and s.name not in SHARED):
        largest[source.name] = max(source, largest.get(source.name, source),
                                   key=lambda s: float(np.abs(s.effects).max()))
    return list(largest.values())


def _error_sources(prior_sigma: Floats, C: Floats, common: Sequence[Source]) -> tuple[Source, ...]:
    """Return the budget: shared errors of the vehicle, and all errors of single legs as one."""
    sigmas = np.sqrt(np.outer(np.diag(C)[:PARAMETER_COUNT], np.diag(C)))
    correlation = np.abs(C[:PARAMETER_COUNT] / sigmas).max(axis=0)
    shared = [Source(name, C[:PARAMETER_COUNT, i] / prior_sigma[i], True)
              for name, i in SHARED.items()
              if correlation[i].max() > 1e-9]      # rounding of a correlation
    shared += common
    unexplained = np.diag(MODEL_FLOOR**2) + sum(s.effects @ s.effects.T for s in shared)
    return (*shared, Source('legs', root_of(C[:PARAMETER_COUNT, :PARAMETER_COUNT] - unexplained)),
            Source('model', np.diag(MODEL_FLOOR)))


def _details(joint: JointEstimate, value: Floats, C: Floats, sources: tuple[Source, ...],
             legs: int) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(C))
    return {
        'legs_used': legs, 'widened': joint.factor,
        'budget': budget_table(sources, PARAMETERS, (float(np.exp(value[LN_K])), 1.0, 1.0)),
        'correlation': correlations(C[:PARAMETER_COUNT, :PARAMETER_COUNT], PARAMETERS),
        'disagreement': {'chi2': joint.chi2, 'freedom': joint.freedom,
                         'between_legs': joint.scatter,
                         'curvature': joint.linearisation_error.tolist()},
        **{CONSTANTS[i]: {'value': float(value[i]), 'sigma': float(sigma[i])}
           for i in IMPERFECTION_CONSTANTS}}
