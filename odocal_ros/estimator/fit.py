# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The iteration of a fit, from a first state and first noise levels to convergence.

Each pass linearises the factors, solves for the step of all states and constants, and updates the
noise levels towards the maximum of the restricted likelihood (level_steps.py). It also increases
the variance of what the other data contradict: outlier fixes, intervals with slip, and priors (of
a lever arm, a delay, a turn-on bias), docs/method.md (S25) to (S30).
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals, Solution
from odocal_ros.estimator.constant_steps import ConstantStep, find_constant_steps
from odocal_ros.estimator.convergence import CONVERGENCE, Progress
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.factors import factor
from odocal_ros.estimator.factors.interval_noise import INTERVAL
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.odometer import SpeedSteps
from odocal_ros.estimator.factors.point_rows import PointRows, rows_per_independent, TAIL_SIGMAS
from odocal_ros.estimator.factors.slow_error import SlowError
from odocal_ros.estimator.level_steps import LevelSteps, prior_information
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import Priors, State

# called after each pass; the last argument is the largest step of a constant, in sigmas
Trace = Callable[[int, State, Levels, WeightedEquations, Solution, float], None]
# sigmas of a prior beyond which it is relaxed. Statistical: one sound prior in 22
RELAXATION_SIGMAS = 2.0
# step along the previous one, as a share of it, below which it is shortened. Judgement: smaller
# reversals converge without it
REVERSAL = -0.5
# statistical: limit of the squared noise of an interval, in sigmas, above which it is an outlier;
# for the IMU of chi2 with six degrees of freedom (two times, three axes), with the same false
# alarm rate
TAIL_LIMITS = np.where(np.isin(factor.VARIANCE_FACTORS, factor.IMU), 20.06, TAIL_SIGMAS**2)
# tuned: share of the variance of a noise that must be observable in its interval; with 0 for all,
# one scale sigma of 60 is doubled (docs/decisions/0016). It is 0 for a bias that steps, which the
# intervals after it observe
MIN_OBSERVED = np.where(np.isin(factor.VARIANCE_FACTORS, factor.IMU[2:]), 0.0, 0.02)
WARM_START_PASSES = 6    # judgement: largest number in a fit that starts from a converged one


@dataclass(frozen=True, eq=False)
class FitSummary:
    """The result of a fit without its equations, which are large; start of a later fit."""

    state: State
    levels: Levels
    priors: Priors           # with the sigmas that the data have increased, (S30)
    initial_priors: Priors   # without
    # (K, VARIANCE_FACTOR_COUNT) factors on the variances of outlier intervals
    variance_factors: Floats
    converged: bool = False     # also if slowly
    # scale and mounting still change, by up to ``max_slow_step`` sigmas
    slowly_converging: bool = False
    iterations: int = 0
    likelihood: float = np.nan  # logarithm of the restricted one, plus a constant


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(FitSummary):
    """The result of a fit, with the equations of its last pass."""

    weighted: WeightedEquations
    solution: Solution
    by_levels: Floats        # (M, L) effects of unit errors of the levels on the constants, (S27b)
    constant_steps: tuple[ConstantStep, ...] = ()     # of scale, yaw, pitch within the leg, (S27c)

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the constants, with the errors of the levels: (M, M)."""
        return self.solution.covariance + self.by_levels @ self.by_levels.T

    def summary(self) -> FitSummary:
        """Return everything but the equations, so that their memory can be released."""
        return FitSummary(**{f.name: getattr(self, f.name) for f in fields(FitSummary)})


def fit(problem: Problem, state: State, levels: Levels, max_iterations: int = 40, *,
        frozen: bool = False, warm_start: FitSummary | None = None,
        trace: Trace | None = None) -> Fit:
    """
    Iterate from a state to the restricted maximum of the likelihood.

    problem, state, levels : the leg and the initial values.   frozen : keep the noise levels
    constant.   warm_start : an earlier fit, whose variance factors and priors are used.   trace :
    called after each pass, for progress and benchmarks.
    """
    priors = initial_priors = problem.priors
    variance_factors = np.ones((len(state.t) - 1, factor.VARIANCE_FACTOR_COUNT))
    if warm_start:
        priors, initial_priors = warm_start.priors, warm_start.initial_priors
        variance_factors = warm_start.variance_factors
    # passes in which outliers are updated: the residuals of earlier ones contain errors of the
    # initial state; after the last one outliers must be constant to converge
    outlier_passes = range(1 if warm_start else 3, 16)
    has_sample_sizes = warm_start is not None and bool(problem.rows_per_independent)
    level_steps = LevelSteps(problem)
    progress = Progress(warm_start is not None, frozen, outlier_passes.start + 2)
    count, state = 0, state.with_mean_up()
    while True:
        count += 1
        weighted = WeightedEquations(
            Equations(problem, state, priors, variance_factors, progress.fitted), levels)
        solution = damp_step(weighted.solve(), progress.previous_step)
        progress.update(count, solution)
        state = state.updated(solution.step, solution.step_constants).with_mean_up()
        weighted.apply_step(solution)
        if trace is not None:
            trace(count, state, levels, weighted, solution, progress.largest_step)
        if progress.converged or count >= max_iterations:
            break
        if count == outlier_passes.start and not has_sample_sizes:
            # of other sensors, and of speed steps, whose errors repeat at constant acceleration
            problem.rows_per_independent = {
                name: rows_per_independent(rows) for name, rows in weighted.factors.items()
                if name in (*problem.external, SpeedSteps.name) and isinstance(rows, PointRows)}
        if not frozen:
            marginals = solution.marginals()
            levels = level_steps.update(weighted, marginals, progress.was_fitted)
            if count in outlier_passes:
                variance_factors = update_variance_factors(weighted, marginals, variance_factors,
                                                           levels)
                priors = relax_priors(initial_priors, priors, state, solution, marginals)
            del marginals
        del weighted, solution      # before the next ones: the largest memory of a long leg
    converged = progress.converged or bool(progress.largest_change < CONVERGENCE.max_final_step)
    slowly_converging = not converged and bool(progress.largest_change < CONVERGENCE.max_slow_step)
    likelihood = -0.5 * (weighted.cost() + weighted.log_R_total() + solution.log_determinant)
    by_levels = weighted.information(solution).effects(prior_information(levels))
    return Fit(state, levels, priors, initial_priors, variance_factors,
               converged or slowly_converging, slowly_converging, count, likelihood,
               weighted=weighted, solution=solution, by_levels=by_levels,
               constant_steps=find_constant_steps(weighted, solution))


def damp_step(solution: Solution, previous_step: Floats) -> Solution:
    """
    Return the step, shortened if it reverses the previous step, docs/method.md (S27a).

    previous_step : (M,) of the constants in the pass before; zero: do not shorten.

    Gauss-Newton omits residuals times second derivatives. They can be as large as the information
    on a constant; full steps then oscillate.
    """
    square = float(previous_step @ solution.reduced @ previous_step)
    product = float(previous_step @ solution.reduced @ solution.step_constants)
    ratio = product / square if square > 0 else 0.0
    fraction = 1 / (1 - ratio) if ratio < REVERSAL else 1.0
    return replace(solution, step=fraction * solution.step,
                   step_constants=fraction * solution.step_constants, step_fraction=fraction)


def update_variance_factors(weighted: WeightedEquations, marginals: JointMarginals,
                            variance_factors: Floats, new_levels: Levels) -> Floats:
    """
    Return the variance factors of outlier intervals: (K, VARIANCE_FACTOR_COUNT).

    new_levels : of the next pass. Factors and levels multiply the variances of the same rows:
    outliers are tested with the new levels.
    """
    rows, levels = weighted[MotionRows], weighted.levels
    jumps, jump_ratio = np.zeros((2, len(variance_factors), 1)), 1.0
    if 'slow' in weighted.factors:
        jumps = weighted[SlowError].jumps(marginals)
        jump_ratio = new_levels['slow'] / levels['slow']
    # estimated noises in sigmas, and the observable shares of their variances
    noise, observed = (np.concatenate(x, axis=1) for x in zip(
        rows.road_noise(marginals), rows.imu_noise(marginals), jumps, strict=True))
    ratios = rows.noise.variance_ratios({n: new_levels[n] / levels[n] for n in INTERVAL})
    ratios = np.concatenate([ratios, np.full((len(ratios), 1), jump_ratio)], axis=1)
    z2 = noise**2 / np.maximum(observed, 1e-12) / ratios
    z2[observed < MIN_OBSERVED] = 0.0
    new_factors = np.clip(variance_factors * z2 / TAIL_LIMITS, 1.0, 1e6)
    # half the change in the logarithm: adjacent intervals share a slip and would oscillate
    new_factors[:, :factor.JUMP] = np.sqrt(variance_factors * new_factors)[:, :factor.JUMP]
    return new_factors


def relax_priors(initial: Priors, current: Priors, state: State, solution: Solution,
                 marginals: JointMarginals) -> Priors:
    """Return priors with larger sigmas where the data contradict them, docs/method.md (S30)."""
    variance = np.diagonal(marginals[0])    # of the first keyframe
    sigma = _widen(initial.sigma, current.sigma, state.constants - initial.mean,
                   np.diag(solution.covariance))
    # not relaxed: sizes of imperfections, which are levels, an offset that is within half a step,
    # and a time constant whose prior contains all receivers
    for constants in (layout.IMPERFECTIONS, layout.SPEED_OFFSET, layout.FIX_MOTION_TIME):
        sigma[constants] = current.sigma[constants]
    return replace(
        current, sigma=sigma,
        gyro_bias_sigma=_widen(initial.gyro_bias_sigma, current.gyro_bias_sigma,
                               state.gyro_bias[0], variance[layout.BG]),
        accel_bias_sigma=_widen(initial.accel_bias_sigma, current.accel_bias_sigma,
                                state.accel_bias[0], variance[layout.BA]))


def _widen(initial: Floats, current: Floats, deviation: Floats, variance: Floats) -> Floats:
    """Return prior sigmas; deviation : estimate minus prior mean.   variance : of the estimate."""
    # at most 30 times the initial one: a larger difference is a wrong setting, which is reported
    has_prior = np.isfinite(initial)
    start, sigma = np.where(has_prior, initial, 1.0), np.where(has_prior, current, 1.0)
    z2 = deviation**2 / np.maximum(sigma**2 - variance, 0.2 * sigma**2)
    wide = np.clip(sigma * np.sqrt(z2) / RELAXATION_SIGMAS, start, 30 * start)
    return np.where(has_prior, wide, np.inf)
