# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The fit of a leg that grows, in windows of ten minutes.

A finished window contributes its marginal information on the constants, (S33). Only the window in
progress is fitted: an update after an hour costs no more than one after ten minutes. It starts
from the previous fit, with keyframes that keep their times and the state extended by dead
reckoning: new samples change the earlier states only a little, so few passes are enough.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

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
from odocal_ros.estimator.fit import Fit, fit, Trace, WARM_START_PASSES, WarmStart
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

# s, judgement: length from which a window is finished, once the next has this length
LONG_WINDOW, NEXT_WINDOW = 600.0, 120.0
UPDATE_PASSES = 2         # judgement: from the last fit; AGAIN_PASSES where that is too few
COLD_START_GROWTH = 1.5       # judgement: growth of the window after which a fit is a cold start
DRIVING_SPEED = 0.5     # m/s; judgement: slower motion does not count as driving


@dataclass(frozen=True, eq=False)
class RunningEstimate:
    """The running estimate."""

    method: MethodResult  # result if the leg ended here
    sigmas: Floats        # (3,) of ln scale, yaw, pitch, also of undetermined ones; inf: fixed
    distance: float       # m
    agility: float        # m^2/s^3, integral of the squared horizontal acceleration
    speed: float          # m/s, median while driving


class GrowingFit:
    """
    The fit of one leg while it grows.

    cpu_s : returns the CPU time used so far, s.   ``cold_start_cpu_s`` : CPU time of the last fit
    if it was a cold start; these become rarer as a window grows.
    """

    def __init__(self, cpu_s: Callable[[], float]) -> None:
        self._cpu_s = cpu_s
        self.cold_start_cpu_s = 0.0
        self._last: WarmStart | None = None
        self._per_effective: dict[str, float] = {}
        self._cold_at = 0.0      # s, length of the window at its last cold start
        # the finished windows, and with the one in progress, and where they end, s
        self._past: tuple[RunningEstimate, float] | None = None
        self._next: tuple[RunningEstimate, float] | None = None

    def forget(self) -> None:
        """Make the next fit a cold start."""
        self._last, self.cold_start_cpu_s = None, 0.0

    def fit(self, view: SmootherLeg, config: Config, trace: Trace) -> RunningEstimate:
        """
        Return the running estimate.

        view : the leg so far: the earlier leg in the same frame, and more.   trace : called
        between passes; its exceptions are passed on.   Raises BadData without a fit and without a
        finished window; the next fit is then a cold start.
        """
        self.cold_start_cpu_s = 0.0
        if self._next is not None and view.t_stop - self._next[1] > NEXT_WINDOW:
            self._past, self._next, self._last = self._next, None, None
        if self._past is not None:
            view = replace(view, t_begin=self._past[1])
        last, self._last = self._last, None
        try:
            now = self._window(last, view, config, trace)
        except BadData:
            if self._past is None:
                raise
            return self._past[0]
        if self._past is not None:
            now = _join_windows(self._past[0], now, config)
        if (self._next is None and view.t_stop - view.t_begin > LONG_WINDOW
                and now.method.verdict is not Verdict.REJECTED):
            self._next = now, view.t_stop
        return now

    def _window(self, last: WarmStart | None, view: SmootherLeg, config: Config,
                trace: Trace) -> RunningEstimate:
        try:
            with raise_on_overflow():
                problem = make_problem(view, config, make_imu_steps(view, SPACING))
                best = self._fit(last, problem, config, trace)
                if not best.converged:
                    raise BadData('the smoother has not converged on the data so far')
                method = make_result(view, problem, best, config)
        except (NotPositive, np.linalg.LinAlgError, FloatingPointError) as error:
            raise BadData(f'the smoother cannot solve the data so far: {error}') from None
        self._last = best.summary()
        self._per_effective = problem.rows_per_independent
        return RunningEstimate(method, _parameter_sigmas(method), *_motion_summary(best.state))

    def _fit(self, last: WarmStart | None, problem: Problem, config: Config, trace: Trace) -> Fit:
        problem.rows_per_independent = self._per_effective
        duration = problem.leg.t_stop - problem.leg.t_begin
        grown = duration > COLD_START_GROWTH * self._cold_at
        begun = None if last is None or grown else extend_warm_start(last, problem)
        if begun is None:
            begin, self._cold_at = self._cpu_s(), duration
            best = best_fit(problem, config, trace)
            self.cold_start_cpu_s = self._cpu_s() - begin if last is not None else 0.0
            return best
        # the levels are kept until the state of the new section is estimated as well
        near = fit(problem, begun.state, begun.levels, 1, frozen=True, warm_start=begun,
                   trace=trace).summary()
        best = fit(problem, near.state, near.levels, UPDATE_PASSES, warm_start=near, trace=trace)
        if not best.converged or best.slowly_converging:
            best = fit(problem, best.state, best.levels, WARM_START_PASSES, warm_start=best,
                       trace=trace)
        return best


def _join_windows(past: RunningEstimate, now: RunningEstimate, config: Config) -> RunningEstimate:
    """Return the running estimate of finished windows and the one in progress."""
    # tyres warm up from the begin of a leg: each window has its own rate
    legs = [replace(one.method, marginal=_information(one.method).with_leg_errors(
                {CONSTANTS[SCALE_BY_TIME]: np.inf}))
            for one in (past, now)]
    whole = combine_legs(legs, [0] * len(legs), config)
    sigmas = _parameter_sigmas(whole)
    # the largest sources are those of the window in progress
    smaller = np.where(np.isfinite(now.sigmas), sigmas / now.sigmas, 1.0)[:, None]
    reasons = {(r.code, r.text): r for r in (*now.method.reasons, *whole.reasons)}
    method = replace(
        now.method, estimates=now.method.estimates | whole.estimates, marginal=whole.marginal,
        reasons=tuple(reasons.values()),
        sources=tuple(replace(s, effects=s.effects * smaller) for s in now.method.sources))
    return RunningEstimate(method, sigmas, past.distance + now.distance, past.agility
                           + now.agility,
                           now.speed)


def _parameter_sigmas(method: MethodResult) -> Floats:
    """Return the sigmas of ln scale, yaw and pitch, also of undetermined ones: (3,)."""
    information = _information(method)
    legs = LinkedLegs([information], CONSTANTS[LN_K], np.empty(0))
    at = legs.indices(0)[:PARAMETER_COUNT]
    sigmas: Floats = np.hypot(np.sqrt(np.diag(legs.solve()[1])[at]), MODEL_FLOOR)
    sigmas[information.prior_sigma[:PARAMETER_COUNT] <= NO_ERROR] = np.inf
    for i, name in enumerate(PARAMETERS):
        e = method.estimates[name]
        if e.value is not None and e.sigma is not None:
            sigmas[i] = e.sigma / abs(e.value) if i == LN_K else e.sigma
    return sigmas


def _information(method: MethodResult) -> MarginalInformation:
    assert method.marginal is not None, 'a fit has one'
    return method.marginal


def _motion_summary(state: State) -> tuple[float, float, float]:
    """Return distance, agility and speed of a window, as ``RunningEstimate`` has them."""
    T, steps = np.diff(state.t), np.linalg.norm(np.diff(state.p_n, axis=0), axis=1)
    moving = steps > DRIVING_SPEED * T
    gained = np.diff(state.v_n[:, :2], axis=0)
    return (max(float(steps.sum()), 1.0), float((gained**2).sum(axis=1) @ (1 / T)),
            float(np.median((steps / T)[moving])) if moving.any() else 0.0)


def make_imu_steps(view: SmootherLeg, spacing: float) -> ImuSteps:
    """
    Return the steps of a leg whose keyframes keep their times as it grows.

    They lie at multiples of ``spacing``; first and last row are keyframes too.
    """
    first, t = imu_rows(view)
    k = nearest_samples(t, np.arange(np.ceil(t[0] / spacing), t[-1] / spacing) * spacing)
    inside = (t[k] > t[0] + spacing / 2) & (t[k] < t[-1] - spacing / 2)
    key = np.unique(np.concatenate([[0], k[inside], [len(t) - 1]]))
    return ImuSteps.between(view, key + first)


def extend_warm_start(last: WarmStart, problem: Problem) -> WarmStart | None:
    """
    Return the start from the last fit, extended to new keyframes.

    None if keyframes differ, or the constants in use: a sensor started to publish.
    """
    t, old = problem.imu.t[problem.imu.key], last.state.t
    rounding = 1e-6     # s
    at = np.clip(np.searchsorted(old, t - rounding), 0, len(old) - 1)
    same = np.abs(old[at] - t) < rounding
    n = len(t) if same.all() else int(np.argmin(same))
    # s at the end, in which rows may have arrived late
    if n < 2 or t[n - 1] < old[-1] - 3.0 or last.priors.used_count != problem.priors.used_count:
        return None
    at = at[:n]
    state = replace(last.state, **{
        name: value[at] for name, value in last.state.keyframe_arrays().items()})
    slipped = [last.variance_factors[a:b].mean(axis=0) for a,
               b in zip(at[:-1], at[1:], strict=True)]
    variance_factors = np.concatenate([slipped, np.ones((len(t) - n, VARIANCE_FACTOR_COUNT))])
    levels = problem.initial_levels.replaced(**last.levels.values)
    return WarmStart(_extend_by_dead_reckoning(state, problem) if n < len(t) else state, levels,
                     last.priors, problem.priors, variance_factors)


def _extend_by_dead_reckoning(state: State, problem: Problem) -> State:
    """Return a state extended by dead reckoning with gyro and odometer to the new keyframes."""
    imu, leg, n = problem.imu, problem.leg, len(state.t)
    key = imu.key[n - 1:]
    rows = replace(imu, key=key)
    K, c = len(key) - 1, state.constants
    on = {name: np.concatenate([value, np.repeat(value[-1:], K, axis=0)])
          for name, value in state.keyframe_arrays().items()}
    t = on['t'] = imu.t[imu.key]
    on['travel_error'][n:] = 0.0
    f = state.scale * state.forward

    travel = as_rolled(leg.travel, c)
    sums, _ = preintegrate(rows, on['gyro_bias'][n:], on['accel_bias'][n:], travel,
                           f, np.empty(0), c)
    for k in range(K):
        on['C_nb'][n + k] = on['C_nb'][n + k - 1] @ sums.R[k]
    C = on['C_nb']
    arm_b = state.C_bv @ (leg.odometer_arm - leg.imu_arm)
    steps = np.einsum('kij,kj->ki', C[n - 1:-1], sums.S @ f) - (C[n:] - C[n - 1:-1]) @ arm_b
    on['p_n'][n:] = on['p_n'][n - 1] + np.cumsum(steps, axis=0)
    on['v_n'][n:] = (C[n:] @ f) * odometer_speed(travel, t[n:])[:, None]
    gained = np.einsum('kij,kj->ki', C[n - 1:-1], sums.dv) + sums.T[:, None] * gravity_n(
        on['p_n'][n:], leg.origin)
    for late in np.flatnonzero(t[n:] + SPEED_WINDOW > leg.travel.t[-1]):
        on['v_n'][n + late] = on['v_n'][n + late - 1] + gained[late]
    return State(**on, constants=c)
