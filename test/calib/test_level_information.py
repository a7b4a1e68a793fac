# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The information on noise levels compared with differences of costs and of solutions."""

from itertools import pairwise

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.estimator.chain import solve
from odocal_ros.estimator.equations import Equations, Weighted
from odocal_ros.estimator.factors import point_rows, signals
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.level_steps import prior_information
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.smoother import best_fit

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
            weighted = Weighted(equations, levels)
            solved = solve(weighted.normal())
            return weighted.apply_step(solved), solved

        yield at, fit.levels


def test_constants_by_level_equal_differences_of_solutions(weighted_equations):
    at, levels = weighted_equations
    both, solved = at()
    information = both.information(solved)
    sigma = np.sqrt(np.diag(solved.covariance))
    for name in (*NAMES, 'correlation_time'):
        up, down = (at(**{name: x})[1].step_constants for x in (STEP, -STEP))
        moves = information.constants_by_level[:, information.names.index(name)]
        np.testing.assert_allclose(moves / sigma, (up - down) / (2 * STEP) / sigma,
                                   rtol=ROUGH, atol=ROUGH * np.abs(moves / sigma).max() + 1e-9)


def test_average_information_is_the_curvature_of_the_cost(weighted_equations):
    """For variance s V the minimum cost has d2C/d(ln s)2 = 4 A + dC/d(ln s), mixed terms 4 A."""
    at, levels = weighted_equations
    both, solved = at()
    information = both.information(solved)
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
    both, solved = at()
    information = both.information(solved)
    prior = prior_information(levels)
    sure = information.effects(dict.fromkeys(prior, 1e12))
    assert (np.sqrt((sure**2).sum(axis=1)) < 1e-5 * np.sqrt(np.diag(solved.covariance))).all()
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
                                   centre, sigma,
                                   sigma)
    wider, weight = marginal.with_errors(effects), 1 / sigma**2

    def posterior(one):
        P = np.linalg.inv(one.information + np.diag(weight))
        return P, P @ (one.gradient + weight * centre)

    (P, x), (wide, same) = posterior(marginal), posterior(wider)
    np.testing.assert_allclose(wide, P + effects @ effects.T, rtol=1e-9)
    np.testing.assert_allclose(same, x, rtol=1e-9)
