# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoother: scale and mounting angles from all samples of a leg at once (docs/method.md)."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.result import MethodResult
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import NotPositive
from odocal_ros.estimator.cold_start import cold_starts, Start
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.factors.slow_error import USUAL_TIME, WHITE_SHARE
from odocal_ros.estimator.fit import Fit, fit, Trace, WARM_START_PASSES
from odocal_ros.estimator.imu import imu_rows
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.estimates import implausible_imu_reasons, refused_result
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.estimator.state import M, SPEED_OFFSET, State
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import nominal_yaw

TRIAL_PASSES = 3    # judgement: passes from each start, before the more likely one continues
# initial size (S28) of the scale error of an odometer inside the receiver, and shortest leg, s,
# that starts with it: ten times the time constant with which satellites correct that odometer;
# shorter legs do not determine its error. Tuned on six drives of 300 s in yards with an error of
# 5 %: from 0.5, the usual size, all fits have scale and accelerometer 3 % off instead, 9 to 12
# sigma; from 50, one of six has (docs/decisions/0019)
RECEIVER_ODOMETER_SIZE, RECEIVER_ODOMETER_LEG = 50.0, 200.0


def smooth(leg: SmootherLeg, config: Config, trace: Trace | None = None) -> MethodResult:
    """
    Return scale, yaw and pitch mounting of a leg from all its samples.

    leg : screened samples.   config : grade, sigmas of lever arms and delays, limits.   trace :
    called after each pass, for benchmarks. An undetermined value is None, with its reason.
    """
    if missing := missing_samples_reason(leg):
        return refused_result([missing], leg.scale_unit, leg.wheels)
    problem = make_problem(leg, config)
    try:
        best = best_fit(problem, config, trace)
    except (NotPositive, np.linalg.LinAlgError) as error:
        reason = Reason(Code.NOT_CONVERGED, f'the equations could not be solved: {error}. '
                        'Likely cause: missing or invalid samples')
        return refused_result([reason], leg.scale_unit, leg.wheels)
    if implausible := implausible_imu_reasons(best):
        return refused_result(implausible, leg.scale_unit, leg.wheels)
    return make_result(leg, problem, best, config)


def best_fit(problem: Problem, config: Config, trace: Trace | None = None) -> Fit:
    """
    Return the fit of a leg, from a cold start.

    There are two starts if accelerations do not determine the heading: the one with the higher
    likelihood after a few passes continues. The offset of a quantised speed is then compared with
    those of rounding and of truncation.
    """
    # nested, so that only one fit is in memory at a time
    return _fix_speed_offset(problem, _fit_from_starts(problem, config, trace), trace)


def _fix_speed_offset(problem: Problem, current: Fit, trace: Trace | None) -> Fit:
    """Return the fit with the offset fixed at 0 or at truncation, if the data select one."""
    coarse = problem.leg.travel.coarse
    if coarse is None or not coarse.truncation:
        return current
    sigma = float(np.sqrt(current.solution.covariance[SPEED_OFFSET, SPEED_OFFSET]))
    estimated = float(current.state.constants[SPEED_OFFSET])
    nearer = coarse.truncation if estimated > coarse.truncation / 2 else 0.0
    deviation, other_deviation = (
        abs(estimated - x) / sigma for x in (nearer, coarse.truncation - nearer))
    # 3.5 sigma: exceeded by one correct drive in 2000; likelihood ratio of 1000 to 1
    if deviation > 3.5 or other_deviation**2 - deviation**2 < 2 * np.log(1e3):
        return current
    constants = current.state.constants.copy()
    constants[SPEED_OFFSET] = nearer
    summary = current.summary()
    del current             # its equations: only one fit is in memory at a time
    is_offset = np.arange(M) == SPEED_OFFSET
    priors = summary.priors
    fixed = replace(priors, mean=np.where(is_offset, nearer, priors.mean),
                    sigma=np.where(is_offset, 1e-3 * coarse.step, priors.sigma))
    warm_start = replace(summary, priors=fixed)
    last = fit(problem, replace(warm_start.state, constants=constants), warm_start.levels,
               WARM_START_PASSES, warm_start=warm_start, frozen=True, trace=trace)
    return replace(last, iterations=warm_start.iterations + last.iterations)


def _fit_from_starts(problem: Problem, config: Config, trace: Trace | None) -> Fit:
    """Return the fit from the cold start, or from the configured yaw if it is more likely."""
    starts = cold_starts(problem.leg, problem.imu, problem.priors, nominal_yaw(config))
    passes = config.leg.compute_limit
    if len(starts) == 1:
        return fit(problem, starts[0].state, _initial_levels(problem, starts[0]), passes,
                   trace=trace)
    trials = (fit(problem, start.state, _initial_levels(problem, start), TRIAL_PASSES, trace=trace)
              for start in starts)
    warm_start = max(trials, key=lambda trial: trial.likelihood).summary()
    last = fit(problem, warm_start.state, warm_start.levels, passes, warm_start=warm_start,
               trace=trace)
    return replace(last, iterations=warm_start.iterations + last.iterations)


def _initial_levels(problem: Problem, start: Start) -> Levels:
    """Return initial levels; the noise of the fixes is at least their scatter about the track."""
    factor, factor_up = (max(1.0, (scatter / sigma)**2) for scatter, sigma in (
        (start.fix_scatter, problem.fix_sigma), (2 * start.fix_scatter, problem.height_sigma)))
    configured = problem.correlation_time
    correlation_time = USUAL_TIME if np.isnan(configured) else configured
    leg, sizes = problem.leg, {}
    if leg.has_accelerometer and leg.t_stop - leg.t_begin > RECEIVER_ODOMETER_LEG:
        sizes['size_fix_error_by_motion'] = RECEIVER_ODOMETER_SIZE
    return problem.initial_levels.replaced(
        fix=WHITE_SHARE * factor, fix_up=4.0 * WHITE_SHARE * factor_up,
        correlation_time=correlation_time, **sizes, **problem.vibrating_levels)


def missing_samples_reason(leg: SmootherLeg) -> Reason | None:
    """Return the reason if a leg has too few fixes with IMU rows, else None."""
    _, t = imu_rows(leg)
    if len(t) < 2:
        return too_few_samples_reason(0, 0.0)
    fixes = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
    return too_few_samples_reason(int(fixes.sum()), float(t[-1] - t[0]))


def too_few_samples_reason(fixes: int, seconds: float) -> Reason | None:
    """Return the reason if a number of fixes, or their duration, is too small, else None."""
    min_fixes, min_seconds = 10, 20.0     # judgement: with less, a cold start fails
    if fixes >= min_fixes and seconds >= min_seconds:
        return None
    # rounded down: 19.97 s are less than 20
    return Reason(Code.SCALE_NOT_DETERMINED, f'{fixes} fixes and '
                  f'{np.floor(10 * seconds) / 10:.1f} s of data; the smoother needs at least '
                  f'{min_fixes} fixes and {min_seconds:.0f} s')


def cramer_rao_bound(leg: SmootherLeg, config: Config, truth: State, levels: Levels) -> Floats:
    """
    Return the Cramer-Rao bound, the covariance of the constants at a known state: (M, M).

    truth : values of all unknowns, at the keyframes of ``make_problem``.   levels : noise levels.
    """
    equations = Equations(make_problem(leg, config), truth, fitted=True)
    return WeightedEquations(equations, levels).solve().covariance
