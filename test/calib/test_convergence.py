# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start, iterations and noise levels of a fit: long legs, damped steps, level errors."""

from dataclasses import replace
from itertools import pairwise

from drives import configured, settings
import numpy as np
from numpy.testing import assert_allclose
import pytest
from smoother_legs import leg_of, made, reason_texts, truth

from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.data.leg import part_of
from odocal_ros.estimator import fit, smooth
from odocal_ros.estimator.chain import Solution, solve
from odocal_ros.estimator.cold_start import AMBIGUOUS_HEADING, change_gyro_bias, cold_starts
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.factors import point_rows, signals
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import damp_step
from odocal_ros.estimator.level_steps import prior_information
from odocal_ros.estimator.preintegrate import preintegrate
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.smoother import best_fit
from odocal_ros.estimator.state import YAW
from odocal_ros.nav.rotations import rotvec, transpose
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import with_settings
from odocal_ros.sim.draw import draw_vehicle
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import SimOptions, simulate

# a consumer gyro that warms up by 10 K: 0.35 deg/s in total, half of it in the first 5 min
WARMS = RealEffects(gyro_slope=(4e-4, -6e-4, 5e-4), warm_rise=10.0, warm_time=400.0)
DRIVE = {'duration': 1860.0, 'imu_rate': 20.0, 'odometer_rate': 10.0, 'imu_grade': 'consumer',
         'real': WARMS}


@pytest.mark.core
def test_rtk_noise_at_1_hz_is_not_treated_as_time_correlated():
    made, _ = draw_vehicle(109_000_002, 'motorway', 'industrial', ('squat', 'sideslip'),
                           duration=300.0, fix_noise='rtk', fix_sigma=0.02)
    assert made.fix_rate == 1.0
    drive = simulate(made)
    config = configured(drive)
    result = combine([calibrate(drive.leg(), config)], config)
    scale = result.estimates['scale_factor']
    # half a minute of white errors determines each end of the drive; plus the limit of 6 ppm
    ends = made.fix_sigma * np.sqrt(2 / 30) / drive.truth.distance
    assert scale.sigma / scale.value < 2 * np.hypot(ends, 6e-6)
    assert Code.FIXES_NOISIER_THAN_SAID not in {reason.code for reason in result.reasons}


@pytest.mark.core
def test_first_iteration_with_fitted_signals_is_not_shortened(monkeypatch):
    """It reverses the effect of signal noise on earlier iterations, of any size."""
    drive = simulate(SimOptions(scenario='town', duration=140.0, imu_rate=20.0, seed=1))
    passes: list[tuple[bool, bool]] = []      # fitted signals; compared with the one before

    class Watched(fit.Equations):
        def __init__(self, *args):
            passes.append((args[4], False))
            super().__init__(*args)

    def damp_step(solution, taken, original=fit.damp_step):
        passes[-1] = passes[-1][0], bool(taken.any())
        return original(solution, taken)
    monkeypatch.setattr(fit, 'Equations', Watched)
    monkeypatch.setattr(fit, 'damp_step', damp_step)
    calibrate(drive.leg(), configured(drive))
    first = passes.index((True, False))
    assert first > 1
    assert all(compared for _, compared in passes[1:first])
    assert all(fitted and compared for fitted, compared in passes[first + 1:])


def step_of(border, reduced):
    """Return a solution with the values that ``damp_step`` reads."""
    return Solution(border[None, :], border, None, 0.0, reduced, None, None, None, None)


def walked(slope, passes):
    """Return the final error of an iteration whose steps are ``slope`` times the error."""
    off, taken = np.array([1.0, -0.5]), np.zeros(2)
    for _ in range(passes):
        found = damp_step(step_of(-slope * off, np.diag([4.0, 1.0])), taken)
        assert_allclose(found.step[0], found.step_constants)
        taken = found.step_constants
        off = off + taken
    return float(np.abs(off).max())


def test_oscillating_steps_are_damped_and_other_steps_are_not():
    # a step of twice the error oscillates; half of it reaches the solution
    assert walked(2.0, 1) == pytest.approx(1.0)
    assert walked(2.0, 2) < 1e-12
    assert walked(0.4, 3) == pytest.approx(0.6**3)
    back = np.array([-2.0, 1.0])
    assert damp_step(step_of(back, np.eye(2)), -back).step_fraction == pytest.approx(0.5)
    assert np.array_equal(damp_step(step_of(back, np.eye(2)), np.zeros(2)).step_constants, back)


def test_best_iteration_is_stated_with_a_wider_sigma_at_the_iteration_limit():
    drive, config, leg = made(duration=200.0, imu_grade='consumer', fix_noise='white')
    whole = smooth(leg, config)
    few = smooth(leg, with_settings(config, {'leg.compute_limit': 5}))
    assert few.details['iterations'] == 5
    assert (few.verdict, few.details['widened']) == (Verdict.CAUTION, 2.0)
    assert 'after 5 iterations the estimates still changed' in reason_texts(few)[
        Code.MODEL_MISMATCH]
    a, b = (m.estimates['scale_factor'] for m in (whole, few))
    assert b.sigma > 1.5 * a.sigma
    assert abs(b.value - drive.truth.scale) < 4 * b.sigma


@pytest.mark.parametrize(('gap', 'parts'), [
    (None, 3), ((-20.0, 605.0), 2), ((595.0, 1225.0), 2), ((1215.0, 1850.0), 2)])
def test_start_with_a_warming_gyro_is_level_in_each_part_with_fixes(gap, parts):
    """A part without fixes is joined with an adjacent part."""
    drive, config, leg = made(**DRIVE)
    if gap:
        seen = (leg.t_fix < gap[0]) | (leg.t_fix > gap[1])
        leg = replace(leg, **{name: getattr(leg, name)[seen] for name in (
            't_fix', 'fixes_n', 'covariance_n', 'rounding_n')})
    problem = make_problem(leg, config)
    start = cold_starts(leg, problem.imu, problem.priors, 0.0)[0].state
    true = truth(drive, config, leg)
    assert (start.t == true.t).all()
    assert len(np.unique(start.gyro_bias, axis=0)) == parts
    assert np.log(start.scale / drive.truth.scale) == pytest.approx(0.0, abs=0.05 if gap else 0.02)
    # the bias changes by 2 mrad/s in the first part; the level oscillates by it over minutes
    angle = np.linalg.norm(rotvec(transpose(true.C_nb) @ start.C_nb), axis=1)
    assert gap or np.percentile(angle, 90) < 0.3


def test_fit_starts_at_the_nominal_yaw_if_accelerations_do_not_give_a_heading():
    """Half a lap at constant speed with a reversed IMU: from a yaw of 0 the fit diverges."""
    yaw = 3.0
    drive = simulate(SimOptions(scenario='oval', duration=300.0, imu_rate=50.0, yaw=yaw,
                                imu_grade='consumer', seed=3))
    config = settings(drive, None, imu__nominal_yaw=yaw)
    begin, end = (drive.leg().start_ns + s * 10**9 for s in (80, 115))
    leg = leg_of(part_of(drive.leg(), begin, end, begin), config)
    problem = make_problem(leg, config)
    start = cold_starts(leg, problem.imu, problem.priors, 0.0)[0]
    assert start.yaw_sigma > AMBIGUOUS_HEADING
    assert start.state.constants[YAW] == 0.0
    found = smooth(leg, config).estimates['yaw_mounting_angle']
    assert abs(found.value - yaw) < 3 * found.sigma < 0.05


def test_start_sums_follow_a_gyro_bias_change_to_first_order():
    _, config, leg = made(duration=120.0, imu_rate=50.0, odometer_rate=20.0)
    imu = make_problem(leg, config).imu
    K = len(imu.keyframes) - 1

    def of_bias(bias, change):
        sums, _ = preintegrate(imu, np.tile(bias, (K, 1)), np.zeros((K, 3)), leg.travel.at,
                               np.array([1.0, 0.0, 0.0]), np.empty(0))
        sums, C = change_gyro_bias(sums, change)
        return sums.R, sums.dv, sums.S[:, :, 0], C
    change, none = np.array([0.01, -0.02, 0.015]), np.zeros(3)
    differences = []
    for delta in (change, change / 2):
        differences.append([np.abs(x - y).max() for x, y in zip(
            of_bias(none, delta), of_bias(delta, none), strict=True)])
    # the remainder is of second order, in intervals of 1 s
    assert (np.divide(*differences) > 3.5).all()
    force_and_speed = np.array([1.0, 10.0, 20.0 / leg.rough_scale])
    assert (differences[0][:3] < force_and_speed * (change @ change)).all()


STEP = 0.02                 # change of the logarithm of a level
# relative: third derivatives are as large as second derivatives: STEP**2 / 6
ROUGH = 1e-3
# at least one level of each factor; a travel error is at its lower limit and cannot decrease
NAMES = ('size_squat', 'gyro', 'along', 'side', 'fix', 'slow', 'size_gyro_axis')


@pytest.fixture(scope='module')
def weighted_equations():
    """Return (function from changed levels to equations and solution, levels), without tails."""
    _, config, leg = made(imu_grade='industrial', duration=135.0, fix_sigma=0.5)
    problem = make_problem(leg, config)
    fit = best_fit(problem, config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(point_rows, 'TAIL_SIGMAS', 1e3)   # otherwise weights change with the levels
        patch.setattr(signals, 'LIKELY_NOISE', 1e-3)    # and derivatives by small rates, too
        # and by the roll of the axes of road noise
        patch.setattr(MotionRows, 'derivative_by_roll', lambda *_: 0.0)
        equations = Equations(problem, fit.state, fit.priors, fit.variance_factors, True)

        def at(**by):
            levels = fit.levels.replaced(**{n: fit.levels[n] * np.exp(x) for n, x in by.items()})
            weighted = WeightedEquations(equations, levels)
            solution = solve(weighted.normal())
            return weighted.apply_step(solution), solution

        yield at, fit.levels


def test_constants_by_level_equal_differences_of_solutions(weighted_equations):
    at, levels = weighted_equations
    both, solution = at()
    information = both.information(solution)
    sigma = np.sqrt(np.diag(solution.covariance))
    for name in (*NAMES, 'correlation_time'):
        up, down = (at(**{name: x})[1].step_constants for x in (STEP, -STEP))
        moves = information.constants_by_level[:, information.names.index(name)]
        np.testing.assert_allclose(moves / sigma, (up - down) / (2 * STEP) / sigma,
                                   rtol=ROUGH, atol=ROUGH * np.abs(moves / sigma).max() + 1e-9)


def test_average_information_is_the_curvature_of_the_cost(weighted_equations):
    """For variance s V the minimum cost has d2C/d(ln s)2 = 4 A + dC/d(ln s), mixed terms 4 A."""
    at, levels = weighted_equations
    both, solution = at()
    information = both.information(solution)
    A = information.average
    np.testing.assert_allclose(A, A.T, atol=1e-9 * A.max())
    assert np.linalg.eigvalsh(A).min() > -1e-9 * A.max()

    def cost(**by):
        return at(**by)[0].cost()

    middle = cost()
    for name, other in pairwise(NAMES):
        j = information.names.index(name)
        up, down = cost(**{name: STEP}), cost(**{name: -STEP})
        curvature, slope = (up - 2 * middle + down) / STEP**2, (up - down) / (2 * STEP)
        rounding = 1e-12 * middle / STEP**2
        assert information.average[j, j] == pytest.approx(
            (curvature - slope) / 4, rel=ROUGH, abs=ROUGH * abs(slope) + rounding), name
        across = sum(a * b * cost(**{name: a * STEP, other: b * STEP})
                     for a in (1, -1) for b in (1, -1)) / (4 * STEP**2)
        assert information.average[j, information.names.index(other)] == pytest.approx(
            across / 4, rel=ROUGH, abs=ROUGH * abs(slope) + rounding), (name, other)


def test_known_levels_add_no_error_and_unknown_levels_add_their_prior(weighted_equations):
    at, levels = weighted_equations
    both, solution = at()
    information = both.information(solution)
    prior = prior_information(levels)
    sure = information.effects(dict.fromkeys(prior, 1e12))
    assert (np.sqrt((sure**2).sum(axis=1)) < 1e-5 * np.sqrt(np.diag(solution.covariance))).all()
    effects = information.effects(prior)
    most = sum(information.constants_by_level[:, i]**2 / prior[n]
               for i, n in enumerate(information.names))
    # joint errors of levels may double the separate errors; the factor is at most their number
    assert ((effects**2).sum(axis=1) <= most * len(prior) + 1e-30).all()


def test_marginal_information_with_level_errors_has_the_sum_of_both_covariances():
    rng = np.random.default_rng(1)
    A, effects = rng.standard_normal((9, 4)), 0.1 * rng.standard_normal((4, 2))
    D, sigma, centre = A.T @ A, np.array([1.0, 2.0, 3.0, np.inf]), rng.standard_normal(4)
    marginal = MarginalInformation(tuple('abcd'), np.zeros(4), D, A.T @ rng.standard_normal(9),
                                   centre, sigma, sigma)
    wider, weight = marginal.with_errors(effects), 1 / sigma**2

    def posterior(one):
        P = np.linalg.inv(one.information + np.diag(weight))
        return P, P @ (one.gradient + weight * centre)

    (P, x), (wide, same) = posterior(marginal), posterior(wider)
    np.testing.assert_allclose(wide, P + effects @ effects.T, rtol=1e-9)
    np.testing.assert_allclose(same, x, rtol=1e-9)
