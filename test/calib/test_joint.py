# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The joint estimate of linear legs equals one fit of all rows, for any observability."""

from dataclasses import replace

from legs_to_combine import largest_deviation, LEGS, NAMES, PRIOR, STEPS, Toy, TRUTH
import numpy as np
import pytest

from odocal_ros.calib.joint import fit_jointly
from odocal_ros.calib.marginal_information import MarginalInformation

pytestmark = pytest.mark.slow
USUAL = {'z3': 0.05}


def of(marginals, steps=STEPS, usual=None):
    return fit_jointly(marginals, steps, 'k', usual_scatter=usual)


@pytest.fixture
def toy():
    return Toy(np.random.default_rng(1))


def test_joint_estimate_equals_one_fit_of_all_rows(toy):
    found, (value, covariance) = of(toy.marginals()), toy.batch()
    assert not found.differing
    assert largest_deviation(found.value, value, covariance) < 1e-9
    assert np.abs(found.covariance / covariance - 1).max() < 1e-6      # small beside large values
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((found.covariance - covariance) / np.outer(sigma, sigma)).max() < 1e-9


def test_separate_errors_of_each_leg_are_unknowns_of_the_fit(toy):
    leg_errors = {'z0': 0.3, 'z3': 0.05}
    value, covariance = toy.batch(leg_errors=[(NAMES.index(n), s) for n, s in leg_errors.items()])
    found = of([b.with_leg_errors(leg_errors) for b in toy.marginals()])
    assert largest_deviation(found.value, value, covariance) < 1e-9


def test_linearisation_point_and_order_of_legs_have_no_effect(toy):
    moved = [toy.marginal(j, TRUTH - 0.2 * j) for j in range(LEGS)]
    a, b = of(toy.marginals()), of(moved)
    assert largest_deviation(a.value, b.value, a.covariance) < 1e-9
    assert a.chi2 == pytest.approx(b.chi2, rel=1e-6)
    marginals = toy.marginals()
    one = of(marginals, np.zeros(LEGS - 1))
    other = of([marginals[j] for j in (3, 0, 4, 1, 2)], np.zeros(LEGS - 1))
    assert largest_deviation(one.value, other.value, one.covariance) < 1e-6
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-6)


def test_selected_constants_have_the_marginal_with_priors_of_the_others(toy):
    whole = toy.marginal(0)
    prior = np.where(np.isin(NAMES, ('z1', 'z2')), 0.0, PRIOR**-2.0)
    H = whole.information + np.diag(prior)
    x = np.linalg.solve(H, whole.gradient + whole.information @ whole.point)
    some = whole.select(('z1', 'z2'))
    C = np.linalg.inv(some.information)
    assert some.names == ('z1', 'z2')
    assert np.linalg.inv(H)[2:4, 2:4] == pytest.approx(C, rel=1e-9)
    assert some.point + C @ some.gradient == pytest.approx(x[2:4], abs=1e-9)


def test_leg_without_information_changes_nothing(toy):
    marginals = toy.marginals()
    nothing = replace(marginals[0], information=np.zeros((5, 5)), gradient=np.zeros(5))
    a, b = of(marginals), of([nothing, *marginals], [0.1, *STEPS])
    assert largest_deviation(a.value, b.value, a.covariance) < 1e-9
    # freedom is a sum of about twenty shares weighted by priors: equal within rounding
    assert (a.freedom, a.chi2) == (pytest.approx(b.freedom, rel=1e-12),
                                   pytest.approx(b.chi2, rel=1e-6))


def test_sections_of_one_leg_count_as_one_leg(toy):
    """The scatter between legs does not apply to sections: the result is as without scatter."""
    still = np.zeros(LEGS - 1)
    whole = of(toy.marginals(), still)
    found = fit_jointly(toy.marginals(), still, 'k', usual_scatter=USUAL,
                        same_drive=[True] * (LEGS - 1))
    assert largest_deviation(found.value, whole.value, whole.covariance) < 1e-6
    assert found.covariance == pytest.approx(whole.covariance, rel=1e-6)
    assert (found.chi2, found.freedom) == (whole.chi2, whole.freedom)
    scattered = of(toy.marginals(), still, USUAL)
    assert scattered.covariance[4, 4] > 1.001 * whole.covariance[4, 4]


def test_chi_square_has_its_expected_mean_and_variance():
    rng = np.random.default_rng(2)
    small = Toy(rng, states=6, rows=60)
    found = [of(small.walk(rng).marginals(), usual=USUAL) for _ in range(400)]
    freedom, chi2 = found[0].freedom, np.array([f.chi2 for f in found])
    # ranks 5, 3, 4, 5, 5 and 4 of the walk, minus 9 unknowns
    # (priors take a small part of what these determine)
    assert freedom == pytest.approx(22 + 4 - 9, abs=0.05)
    assert chi2.mean() == pytest.approx(freedom, abs=4 * np.sqrt(2 * freedom / 400))
    assert chi2.var() == pytest.approx(2 * freedom, rel=0.33)      # 4 sigmas of it
    # each of five constants in one of 300 draws, all together in one of 20
    assert np.mean([bool(f.differing) for f in found]) < 0.035
    assert 0.03 < np.mean([f.factor > 1 for f in found]) < 0.07
    z = np.concatenate([f.deviation.ravel() for f in found])
    assert z[z != 0].std() == pytest.approx(1.0, abs=0.03)


def test_leg_and_constant_that_differ_are_named():
    rng = np.random.default_rng(3)
    small = Toy(rng, states=6, rows=40)
    constants = np.tile(TRUTH, (LEGS, 1))
    constants[3, 4] += 5.0
    marginals = small.draw(rng, constants).marginals()
    # the prior of that leg is relaxed, as in a leg where the data contradict it
    marginals[3] = replace(marginals[3], relaxed_sigma=np.where(PRIOR == 1.0, 5.0, PRIOR))
    found = of(marginals, usual=USUAL)
    assert found.differing == ('z3',)
    assert np.argmax(np.abs(found.deviation[:, 4])) == 3
    # one of five legs deviates by 5: scatter 5 / sqrt(5), mean shifted by 1
    assert found.scatter['z3'] == pytest.approx(5 / np.sqrt(5), rel=0.5)
    assert abs(found.value[4] - TRUTH[4]) < 2 * np.sqrt(found.covariance[4, 4])
    assert np.abs((found.value - TRUTH) / np.sqrt(np.diag(found.covariance))).max() < 3.5


def test_disagreement_without_a_single_cause_widens_all_constants():
    rng = np.random.default_rng(4)
    small = Toy(rng, states=6, rows=40)
    constants = TRUTH + 3.0 * rng.standard_normal((LEGS, 5))
    found = of(small.draw(rng, constants).marginals(), usual=USUAL)
    assert found.differing[0] == 'z3'
    assert found.factor > 1.5


def scale_and_yaw(yaw, *information):
    unit = np.full(2, np.inf)
    return MarginalInformation(('k', 'yaw'), np.array([0.0, yaw]), np.diag(information),
                               np.zeros(2), np.zeros(2), unit, unit)


def test_leg_far_from_its_linearisation_point_has_less_weight():
    # the first leg has no yaw information and is linearised 0.1 rad off: scale error 0.5 %
    legs = [scale_and_yaw(0.1, 1e12, 1e-2), scale_and_yaw(0.0, 1e8, 1e8)]
    found = fit_jointly(legs, [0.0], 'k', ('yaw',), ('k', 'yaw'))
    assert found.linearisation_error == pytest.approx([0.005, 0.0], abs=1e-9)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(1e-4, rel=1e-3)
    assert np.sqrt(fit_jointly(legs, [0.0], 'k').covariance[0, 0]) < 2e-6


def test_angles_near_half_a_turn_are_combined_without_a_jump():
    legs = [scale_and_yaw(yaw, 1e6, 1e6) for yaw in (np.pi - 1e-3, 1e-3 - np.pi)]
    found = fit_jointly(legs, [0.0], 'k', ('yaw',), ('yaw',))
    assert abs(found.value[1]) == pytest.approx(np.pi, abs=1e-9)
    assert not found.differing
