# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The iteration of a fit: linearise, solve, update the noise levels, until convergence.

The variance components converge to the maximum of the restricted likelihood by the ratio of their
quadratic sums to the expectation, with over-relaxation: docs/method.md (S26), (S27). Outliers have
heavy tails: fixes, slips of an interval, and priors (of a lever arm, a delay, a turn-on bias) that
the data contradict.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals, Solved
from odocal_ros.estimator.equations import ConstantStep, Equations, find_constant_steps, Weighted
from odocal_ros.estimator.factors import factor
from odocal_ros.estimator.factors.interval_noise import INTERVAL
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.odometer import SpeedSteps
from odocal_ros.estimator.factors.point_rows import (
    count_rows_per_independent,
    PointRows,
    TAIL_SIGMAS,
)
from odocal_ros.estimator.factors.slow_error import SlowError
from odocal_ros.estimator.level_steps import prior_information, update_levels
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import Priors, State

# called after each pass; the last argument is the largest step of a constant, in sigmas
Trace = Callable[[int, State, Levels, Weighted, Solved, float], None]
# sigmas of a prior beyond which it is relaxed. Statistical: one sound prior in 22
RELAXATION_SIGMAS = 2.0


@dataclass(frozen=True)
class Convergence:
    """
    Convergence limits: steps of the constants in the last pass, in sigmas.

    Judgement: the remaining change is then far below the stated sigma. Measured: with ``max_step``
    of 0.03, results differ by 0.02 sigma (rms of 29 drives; at most 0.08), passes are 1.11 times
    as many. With ``max_sigma_change`` of 0.05, some sigmas are up to 19 % too large. Without
    ``max_last_sigma_change``, those of 3 of 21 motorways with RTK at 1 Hz are 3 to 6 times too
    large. A change that grows has not converged: one sigma of a gyro without its y axis was 25 %
    too large, for 1.01 times the passes (60 drives).
    """

    # residuals are noise from the first on, and no more from the second; the first step with
    # derivatives by the fitted signal takes back what noise made of it, however much
    fitted_below: float = 1.0
    measured_above: float = 4.0
    max_step: float = 0.08         # of any constant, in the last pass
    other_weight: float = 0.3      # of the constants but scale and mounting, in ``max_step``
    max_final_step: float = 0.1    # of scale and mounting, when the passes are used up
    # the same, for a fit that converges slowly: its values are reported with wider sigmas
    max_slow_step: float = 0.5
    max_sigma_change: float = 0.02    # relative, of the sigmas of scale and mounting
    # the same, one pass earlier: a single small change may be between a rise and a fall
    max_last_sigma_change: float = 0.06
    # rad, sigma: an angle known no better drifts where the cost is flat, and is refused
    flat_angle: float = 0.1


CONVERGENCE = Convergence()
# definition: weights of steps of the constants, and sigmas from which they do not count
STEP_WEIGHTS = np.where(np.arange(layout.M) < factor.PARAMETER_COUNT, 1.0,
                        CONVERGENCE.other_weight)
FLAT_SIGMAS = np.full(layout.M, np.inf)
FLAT_SIGMAS[[layout.YAW, layout.PITCH]] = CONVERGENCE.flat_angle
# share of the last step from which on a step that turns back is shortened. Judgement: smaller
# reversals converge without it
TURNS_BACK = -0.5
# statistical: squares of noises, in sigmas, beyond which an interval is an outlier; chi2 of the
# six of a sensor (two times, three axes) is as seldom above its limit
TAIL_LIMITS = np.where(np.isin(factor.VARIANCE_FACTORS, factor.IMU), 20.06, TAIL_SIGMAS**2)
# tuned: least observable share of a noise; with 0 for all, one scale sigma of 60 is doubled
# (docs/decisions/0016). A bias that steps is observed by the intervals after it, and has none
LEAST_OBSERVED = np.where(np.isin(factor.VARIANCE_FACTORS, factor.IMU[2:]), 0.0, 0.02)
WARM_START_PASSES = 6    # judgement: of a fit that starts from a converged one


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Initial values of a fit."""

    state: State
    levels: Levels
    priors: Priors           # as relaxed by the data
    first: Priors            # before any was relaxed
    # (K, VARIANCE_FACTOR_COUNT) factors on variances: slips, jumps of slow fix errors
    variance_factors: Floats


@dataclass(frozen=True, eq=False)
class FitSummary(WarmStart):
    """The result of the iteration without the equations, which are large."""

    converged: bool          # also if slowly
    # scale and mounting still change by up to ``max_slow_step`` sigmas: sigmas are widened
    slowly_converging: bool
    iterations: int
    likelihood: float        # restricted, its logarithm but for a constant; NaN: not iterated


@dataclass(frozen=True, eq=False)
class Fit(FitSummary):
    """The result of the iteration."""

    weighted: Weighted
    solved: Solved
    by_levels: Floats        # (M, L) what unit errors of levels do to the constants, sizes last
    steps: tuple[ConstantStep, ...] = ()     # of constants within the leg

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the constants including that by the levels, (S27b): (M, M)."""
        return self.solved.covariance + self.by_levels @ self.by_levels.T

    def summary(self) -> FitSummary:
        """Return everything but the equations, so that their memory can be released."""
        return FitSummary(self.state, self.levels, self.priors, self.first, self.variance_factors,
                          self.converged, self.slowly_converging, self.iterations,
                          self.likelihood)


class _Progress:
    """Convergence of a fit from pass to pass."""

    def __init__(self, fitted: bool, frozen: bool, fewest: int) -> None:
        """Begin; fitted : derivatives by the fitted signal; fewest : passes with free levels."""
        self.fitted = self.was_fitted = fitted      # in the next pass, in the last
        self.frozen, self.fewest, self.converged = frozen, fewest, False
        # of scale and mounting: sigmas, their relative change, the larger of it and the last step
        self.sigma, self.change = np.ones(factor.PARAMETER_COUNT), np.inf
        self.largest_change = self.largest_step = np.inf      # steps in sigmas
        self.previous_step = np.zeros(layout.M)

    def update(self, count: int, solved: Solved) -> None:
        """Take the steps and sigmas of a pass."""
        sigma = np.sqrt(np.diag(solved.covariance))
        step = np.abs(solved.step_border / sigma)
        self.largest_step = float((step * np.where(sigma < FLAT_SIGMAS, STEP_WEIGHTS, 0.0)).max())
        before, self.sigma, last_change = self.sigma, sigma[:factor.PARAMETER_COUNT], self.change
        self.change = np.abs(np.log(self.sigma / before)).max()
        self.largest_change = max(step[:factor.PARAMETER_COUNT].max(), self.change)
        steady = count > self.fewest and last_change < CONVERGENCE.max_last_sigma_change \
            and self.change < min(CONVERGENCE.max_sigma_change, last_change)
        self.converged = bool(self.fitted and self.largest_step < CONVERGENCE.max_step
                              and (self.frozen or steady))
        first_fitted, self.was_fitted = self.fitted and not self.was_fitted, self.fitted
        self.fitted = first_fitted or self.largest_step < (
            CONVERGENCE.measured_above if self.fitted else CONVERGENCE.fitted_below)
        # the first step by the fitted signal may take back all of the one before
        fits_next = self.fitted and not self.was_fitted
        self.previous_step = np.zeros(layout.M) if fits_next else solved.step_border


def fit(problem: Problem, state: State, levels: Levels, max_iterations: int = 40, *,
        frozen: bool = False, warm_start: WarmStart | None = None,
        trace: Trace | None = None) -> Fit:
    """
    Iterate from a state to the restricted maximum of the likelihood.

    problem, state, levels : the leg and the initial values.   frozen : keep the noise levels
    constant.   warm_start : from an earlier fit, whose slips and priors are used.   trace :
    called after each pass, for progress and benchmarks.
    """
    priors, first = (warm_start.priors, warm_start.first) if warm_start else (problem.priors,) * 2
    variance_factors = warm_start.variance_factors if warm_start else np.ones(
        (len(state.t) - 1, factor.VARIANCE_FACTOR_COUNT))
    # passes in which heavy tails are updated: earlier, the residuals contain the start; later,
    # the tails are constant
    tails, last_tails = 1 if warm_start else 3, 15
    # pass that estimates the effective sample size; of two starts only that of the better one
    sample_size_pass = 3 if warm_start is None else 0 if problem.rows_per_independent else 1
    pace: dict[str, tuple[float, float]] = {}
    progress = _Progress(warm_start is not None, frozen, tails + 2)
    count, state = 0, state.level()
    while True:
        count += 1
        weighted = Equations(problem, state, priors, variance_factors, progress.fitted).at(levels)
        solved = damp_step(weighted.solved(), progress.previous_step)
        progress.update(count, solved)
        state = state.moved(solved.step, solved.step_border)
        weighted.apply_step(solved)
        if trace is not None:
            trace(count, state, levels, weighted, solved, progress.largest_step)
        if progress.converged or count >= max_iterations:
            break
        if count == sample_size_pass:
            problem.rows_per_independent = find_rows_per_independent(problem, weighted)
        if not frozen:
            marginals = solved.marginals()
            tail, before_levels = tails <= count <= last_tails, levels
            levels = update_levels(weighted, marginals, levels, problem, pace, progress.was_fitted)
            # slips and levels are factors on the same rows: slips are evaluated at the new levels
            if tail:
                variance_factors = update_variance_factors(weighted, marginals, variance_factors,
                                                           before_levels, levels)
                priors = relax_priors(first, priors, state, solved, marginals)
            del marginals
        del weighted, solved      # the largest memory of a long leg
    converged = progress.converged or bool(progress.largest_change < CONVERGENCE.max_final_step)
    slowly_converging = not converged and bool(progress.largest_change < CONVERGENCE.max_slow_step)
    likelihood = -0.5 * (weighted.cost() + weighted.log_R_total() + solved.log_determinant)
    by_levels = weighted.information(solved).effects(prior_information(levels))
    return Fit(state, levels, priors, first, variance_factors, converged or slowly_converging,
               slowly_converging, count, likelihood, weighted, solved, by_levels,
               find_constant_steps(weighted, solved))


def damp_step(solved: Solved, previous_step: Floats) -> Solved:
    """
    Return the step, shortened if it reverses the previous step, docs/method.md (S27a).

    Gauss-Newton omits residuals times second derivatives. They can be as large as the information
    on a constant; full steps then oscillate.
    """
    before = float(previous_step @ solved.reduced @ previous_step)
    along = float(previous_step @ solved.reduced @ solved.step_border)
    back = along / before if before > 0 else 0.0
    by = 1 / (1 - back) if back < TURNS_BACK else 1.0
    return replace(solved, step=by * solved.step, step_border=by * solved.step_border, taken=by)


def update_variance_factors(weighted: Weighted, marginals: JointMarginals,
                            variance_factors: Floats, levels: Levels,
                            onward: Levels) -> Floats:
    """
    Return the variance factors of outlier intervals: (K, VARIANCE_FACTOR_COUNT).

    levels, onward : of this pass and of the next; outliers are evaluated at the next.
    """
    rows = weighted[MotionRows]
    jumps = np.zeros((2, len(variance_factors), 1))
    if 'slow' in weighted.parts:
        jumps = weighted[SlowError].jumps(marginals)
    noise, found = (np.concatenate(x, axis=1) for x in zip(
        rows.road_noise(marginals), rows.imu_noise(marginals), jumps, strict=True))
    grown = rows.noise.grown({n: onward[n] / levels[n] for n in INTERVAL})
    jumped = onward['slow'] / levels['slow'] if 'slow' in weighted.parts else 1.0
    grown = np.concatenate([grown, np.full((len(grown), 1), jumped)], axis=1)
    z2 = noise**2 / np.maximum(found, 1e-12) / grown
    z2[found < LEAST_OBSERVED] = 0.0          # not observable in this interval
    new_factors = np.clip(variance_factors * z2 / TAIL_LIMITS, 1.0, 1e6)
    # half the change in the logarithm: adjacent intervals share a slip and would oscillate
    new_factors[:, :factor.JUMP] = np.sqrt(variance_factors * new_factors)[:, :factor.JUMP]
    return new_factors


def find_rows_per_independent(problem: Problem, weighted: Weighted) -> dict[str, float]:
    """Return rows per independent row, by residuals of other sensors and of speed steps."""
    # at constant acceleration errors of speed steps repeat
    return {name: count_rows_per_independent(part) for name, part in weighted.parts.items()
            if name in (*problem.external, SpeedSteps.name) and isinstance(part, PointRows)}


def relax_priors(first: Priors, now: Priors, state: State, solved: Solved,
                 marginals: JointMarginals) -> Priors:
    """Return priors widened where the data are far from their centre, docs/method.md (S30)."""
    n = solved.step.shape[1]
    P0 = np.diagonal(marginals[0])[:n]
    variance = np.diag(solved.covariance)
    constants = _widen(first.constants, now.constants, state.constants - first.centre, variance)
    # sizes of imperfections are levels; the grid holds that offset; times are of receivers as made
    for held in (layout.IMPERFECT, layout.SPEED_OFFSET, layout.FIX_TIME):
        constants[held] = now.constants[held]
    return replace(
        now,
        gyro_bias=_widen(first.gyro_bias, now.gyro_bias, state.gyro_bias[0], P0[layout.BG]),
        accel_bias=_widen(first.accel_bias, now.accel_bias, state.accel_bias[0], P0[layout.BA]),
        constants=constants)


def _widen(first: Floats, now: Floats, off: Floats, variance: Floats) -> Floats:
    """Return sigmas of which ``off`` is RELAXATION_SIGMAS at most, none below the first."""
    # at most 30 times the first: a larger difference is a wrong setting, which is reported
    held = np.isfinite(first)
    first_, now_ = np.where(held, first, 1.0), np.where(held, now, 1.0)
    z2 = off**2 / np.maximum(now_**2 - variance, 0.2 * now_**2)
    wide = np.clip(now_ * np.sqrt(z2) / RELAXATION_SIGMAS, first_, 30 * first_)
    return np.where(held, wide, np.inf)
