# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The fit of a leg that is still being driven, repeated as it grows.

The leg is divided into windows of ten minutes. A finished window contributes its marginal
information on the constants, (S33) of docs/method.md. Only the window in progress is fitted: an
update after an hour costs no more than one after ten minutes. It starts from the previous fit,
with keyframes that keep their times and the state extended by dead reckoning: new samples change
the earlier states only a little, so few passes are enough.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.linked_legs import LinkedLegs
from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.calib.result import MethodResult, raise_on_overflow
from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadData
from odocal_ros.estimator.chain import NotPositive
from odocal_ros.estimator.factors.factor import PARAMETER_COUNT, VARIANCE_FACTOR_COUNT
from odocal_ros.estimator.factors.odometer import as_rolled, odometer_speed, SPEED_WINDOW
from odocal_ros.estimator.fit import Fit, fit, FitSummary, Trace, WARM_START_PASSES
from odocal_ros.estimator.imu import imu_rows, ImuSteps, nearest_samples
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.preintegrate import preintegrate
from odocal_ros.estimator.prepare import make_problem, SPACING
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.estimator.result.remarks import MODEL_FLOOR
from odocal_ros.estimator.several import combine_legs
from odocal_ros.estimator.smoother import best_fit
from odocal_ros.estimator.state import CONSTANTS, LN_K, NO_ERROR, SCALE_BY_TIME, State
from odocal_ros.nav.dead_reckoning import gravity_n
from odocal_ros.reasons import Verdict
from odocal_ros.settings.config import Config

# s, judgement: length of a window, and of the next one before the window is no longer fitted
LONG_WINDOW, NEXT_WINDOW = 600.0, 120.0
UPDATE_PASSES = 2       # judgement: from the last fit; WARM_START_PASSES more without convergence
COLD_START_GROWTH = 1.5       # judgement: growth of the window after which a fit is a cold start
DRIVING_SPEED = 0.5     # m/s; judgement: slower motion does not count as driving


@dataclass(frozen=True, eq=False)
class RunningEstimate:
    """The result of a leg so far, and figures of its motion for forecasts."""

    method: MethodResult  # result if the leg ended here
    sigmas: Floats        # (3,) of ln K, yaw, pitch, also of undetermined ones; inf: fixed
    distance: float       # m
    agility: float        # m^2/s^3, integral of the squared horizontal acceleration
    speed: float          # m/s, median while driving


class WindowEnd(NamedTuple):
    """Estimate of a leg up to the end of a window."""

    estimate: RunningEstimate
    t: float    # s since the start mark


class GrowingFit:
    """
    The fit of one leg while it grows.

    cpu_s : returns the CPU time used so far, s.   ``cold_start_cpu_s`` : CPU time, s, of the last
    fit if it was a cold start after an earlier fit, else 0.
    """

    def __init__(self, cpu_s: Callable[[], float]) -> None:
        self._cpu_s = cpu_s
        self.cold_start_cpu_s = 0.0
        self._last: FitSummary | None = None     # summary of the last fit, start of the next one
        self._rows_per_independent: dict[str, float] = {}
        self._cold_start_length = 0.0      # s, length of the window at its last cold start
        # estimate of all finished windows; estimate that includes the window in progress, once
        # this is long enough: it becomes ``_finished`` when NEXT_WINDOW more has been driven
        self._finished: WindowEnd | None = None
        self._candidate: WindowEnd | None = None

    def forget(self) -> None:
        """Make the next fit a cold start."""
        self._last, self.cold_start_cpu_s = None, 0.0

    def fit(self, leg: SmootherLeg, config: Config, trace: Trace) -> RunningEstimate:
        """
        Return the running estimate.

        leg : samples so far, in the same frame as before.   trace : called between passes, may
        raise an exception to stop the fit.

        Raises BadData: the fit fails and no window is finished; the next fit is a cold start.
        """
        self.cold_start_cpu_s = 0.0
        if self._candidate is not None and leg.t_stop - self._candidate.t > NEXT_WINDOW:
            self._finished, self._candidate, self._last = self._candidate, None, None
        window = leg if self._finished is None else replace(leg, t_begin=self._finished.t)
        last, self._last = self._last, None
        try:
            estimate = self._fit_window(last, window, config, trace)
        except BadData:
            if self._finished is None:
                raise
            return self._finished.estimate
        if self._finished is not None:
            estimate = _join_windows(self._finished.estimate, estimate, config)
        if (self._candidate is None and window.t_stop - window.t_begin > LONG_WINDOW
                and estimate.method.verdict is not Verdict.REJECTED):
            self._candidate = WindowEnd(estimate, window.t_stop)
        return estimate

    def _fit_window(self, last: FitSummary | None, window: SmootherLeg, config: Config,
                    trace: Trace) -> RunningEstimate:
        """Return the estimate of the window in progress; raises BadData."""
        try:
            with raise_on_overflow():
                problem = make_problem(window, config, make_imu_steps(window, SPACING))
                best = self._fit(last, problem, config, trace)
                if not best.converged:
                    raise BadData('the smoother has not converged on the data so far')
                method = make_result(window, problem, best, config)
        except (NotPositive, np.linalg.LinAlgError, FloatingPointError) as error:
            raise BadData(f'the smoother cannot solve the data so far: {error}') from None
        self._last = best.summary()
        self._rows_per_independent = problem.rows_per_independent
        return RunningEstimate(method, _parameter_sigmas(method), *_motion_summary(best.state))

    def _fit(self, last: FitSummary | None, problem: Problem, config: Config, trace: Trace) -> Fit:
        """Return the fit of a window, from the last fit if there is one and it can be extended."""
        problem.rows_per_independent = self._rows_per_independent
        duration = problem.leg.t_stop - problem.leg.t_begin
        has_grown = duration > COLD_START_GROWTH * self._cold_start_length
        start = None if last is None or has_grown else extend_warm_start(last, problem)
        if start is None:
            cpu_s, self._cold_start_length = self._cpu_s(), duration
            best = best_fit(problem, config, trace)
            self.cold_start_cpu_s = self._cpu_s() - cpu_s if last is not None else 0.0
            return best
        # first pass with fixed noise levels: the new keyframes are not estimated yet
        first = fit(problem, start.state, start.levels, 1, frozen=True, warm_start=start,
                    trace=trace).summary()
        best = fit(problem, first.state, first.levels, UPDATE_PASSES, warm_start=first,
                   trace=trace)
        if not best.converged or best.slowly_converging:
            best = fit(problem, best.state, best.levels, WARM_START_PASSES, warm_start=best,
                       trace=trace)
        return best


def _join_windows(finished: RunningEstimate, current: RunningEstimate,
                  config: Config) -> RunningEstimate:
    """Return the running estimate of finished windows and the one in progress."""
    # the rate of the scale differs between windows, as tyres warm up from the start of a leg
    legs = [replace(method, marginal=_information(method).with_leg_errors(
        {CONSTANTS[SCALE_BY_TIME]: np.inf})) for method in (finished.method, current.method)]
    joint = combine_legs(legs, [0] * len(legs), config)
    sigmas = _parameter_sigmas(joint)
    # the largest sources are those of the window in progress
    sigma_ratio = np.where(np.isfinite(current.sigmas), sigmas / current.sigmas, 1.0)[:, None]
    reasons = {(r.code, r.text): r for r in (*current.method.reasons, *joint.reasons)}
    method = replace(
        current.method, estimates=current.method.estimates | joint.estimates,
        marginal=joint.marginal, reasons=tuple(reasons.values()),
        sources=tuple(replace(s, effects=s.effects * sigma_ratio) for s in current.method.sources))
    return RunningEstimate(method, sigmas, finished.distance + current.distance,
                           finished.agility + current.agility, current.speed)


def _parameter_sigmas(method: MethodResult) -> Floats:
    """Return the sigmas of ln scale, yaw and pitch, also of undetermined ones: (3,)."""
    information = _information(method)
    legs = LinkedLegs([information], CONSTANTS[LN_K], np.empty(0))
    indices = legs.indices(0)[:PARAMETER_COUNT]
    sigmas: Floats = np.hypot(np.sqrt(np.diag(legs.solve()[1])[indices]), MODEL_FLOOR)
    sigmas[information.prior_sigma[:PARAMETER_COUNT] <= NO_ERROR] = np.inf
    for i, name in enumerate(PARAMETERS):
        e = method.estimates[name]
        if e.value is not None and e.sigma is not None:
            sigmas[i] = e.sigma / abs(e.value) if i == LN_K else e.sigma
    return sigmas


def _information(method: MethodResult) -> MarginalInformation:
    assert method.marginal is not None, 'a fit has marginal information'
    return method.marginal


def _motion_summary(state: State) -> tuple[float, float, float]:
    """Return ``distance``, ``agility`` and ``speed`` of a window, see ``RunningEstimate``."""
    T, steps = np.diff(state.t), np.linalg.norm(np.diff(state.p_n, axis=0), axis=1)
    moving = steps > DRIVING_SPEED * T
    change = np.diff(state.v_n[:, :2], axis=0)
    return (max(float(steps.sum()), 1.0), float((change**2).sum(axis=1) @ (1 / T)),
            float(np.median((steps / T)[moving])) if moving.any() else 0.0)


def make_imu_steps(leg: SmootherLeg, spacing: float) -> ImuSteps:
    """Return IMU steps with keyframes at multiples of spacing, s, and at both ends of a leg."""
    first, t = imu_rows(leg)
    k = nearest_samples(t, np.arange(np.ceil(t[0] / spacing), t[-1] / spacing) * spacing)
    inside = (t[k] > t[0] + spacing / 2) & (t[k] < t[-1] - spacing / 2)
    keyframes = np.unique(np.concatenate([[0], k[inside], [len(t) - 1]]))
    return ImuSteps.between(leg, first + keyframes)


def extend_warm_start(last: FitSummary, problem: Problem) -> FitSummary | None:
    """
    Return the start of a fit from the last one, extended to new keyframes.

    None if earlier keyframes differ, or the number of used constants: a sensor started to publish.
    """
    t, last_t = problem.imu.t_keyframes, last.state.t
    rounding = 1e-6     # s
    nearest = np.clip(np.searchsorted(last_t, t - rounding), 0, len(last_t) - 1)
    is_old = np.abs(last_t[nearest] - t) < rounding
    n = len(t) if is_old.all() else int(np.argmin(is_old))      # keyframes that the last fit has
    # samples of the last 3 s may have arrived late
    if n < 2 or t[n - 1] < last_t[-1] - 3.0 or last.priors.used_count != problem.priors.used_count:
        return None
    old = nearest[:n]
    state = replace(last.state, **{
        name: value[old] for name, value in last.state.keyframe_arrays().items()})
    # the last fit may have keyframes that the new one lacks: means over the joined intervals
    old_factors = [last.variance_factors[first:end].mean(axis=0)
                   for first, end in zip(old[:-1], old[1:], strict=True)]
    variance_factors = np.concatenate([old_factors, np.ones((len(t) - n, VARIANCE_FACTOR_COUNT))])
    levels = problem.initial_levels.replaced(**last.levels.values)
    return FitSummary(_extend_by_dead_reckoning(state, problem) if n < len(t) else state, levels,
                     last.priors, problem.priors, variance_factors)


def _extend_by_dead_reckoning(state: State, problem: Problem) -> State:
    """Return a state extended by dead reckoning with gyro and odometer to the new keyframes."""
    imu, leg, n = problem.imu, problem.leg, len(state.t)
    new = replace(imu, keyframes=imu.keyframes[n - 1:])
    new_count, c = len(new.keyframes) - 1, state.constants
    out = {name: np.concatenate([value, np.repeat(value[-1:], new_count, axis=0)])
           for name, value in state.keyframe_arrays().items()}
    t = out['t'] = imu.t_keyframes
    out['travel_error'][n:] = 0.0
    f = state.scale * state.forward
    travel = as_rolled(leg.travel, c)
    sums, _ = preintegrate(new, out['gyro_bias'][n:], out['accel_bias'][n:], travel, f,
                           np.empty(0), c)
    C = out['C_nb']
    for k in range(new_count):
        C[n + k] = C[n + k - 1] @ sums.R[k]
    arm_b = state.C_bv @ (leg.odometer_arm - leg.imu_arm)
    steps = np.einsum('kij,kj->ki', C[n - 1:-1], sums.S @ f) - (C[n:] - C[n - 1:-1]) @ arm_b
    out['p_n'][n:] = out['p_n'][n - 1] + np.cumsum(steps, axis=0)
    out['v_n'][n:] = (C[n:] @ f) * odometer_speed(travel, t[n:])[:, None]
    change = np.einsum('kij,kj->ki', C[n - 1:-1], sums.dv) + sums.T[:, None] * gravity_n(
        out['p_n'][n:], leg.origin)
    # velocities after the last odometer reading are predicted by the IMU
    for i in np.flatnonzero(t[n:] + SPEED_WINDOW > leg.travel.t[-1]):
        out['v_n'][n + i] = out['v_n'][n + i - 1] + change[i]
    return State(**out, constants=c)
