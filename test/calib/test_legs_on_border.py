# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs combined on their border are one fit of all their rows, whatever each is blind to."""

from dataclasses import replace
import re
from types import SimpleNamespace

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.calib.border import Border
from odocal_ros.calib.joint import joint
from odocal_ros.calib.result import Estimate, LegResult
from odocal_ros.calib.wheels.wheel_slips import NO_SLIPS
from odocal_ros.estimator import several, smooth
from odocal_ros.estimator.result.remarks import MODEL_FLOOR
from odocal_ros.estimator.several import combine_legs
from odocal_ros.pipeline.beyond_model import with_wheel_change
from odocal_ros.pipeline.combination import combine
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import with_settings

pytestmark = pytest.mark.slow
NAMES = ('k', 'z0', 'z1', 'z2', 'z3')
LEGS, STATES, ROWS = 5, 80, 130
TRUTH = np.array([0.1, 0.3, -0.2, 0.05, 0.4])
PRIOR = np.array([np.inf, 2.0, 0.5, 0.5, 1.0])
STEPS = np.array([0.02, 0.0, 0.05, 0.01])


class Toy:
    """Legs of linear rows of unit variance: b = A (states) + B (constants) + noise."""

    def __init__(self, rng, legs=LEGS, states=STATES, rows=ROWS):
        self.A = rng.standard_normal((legs, rows, states))
        self.B = rng.standard_normal((legs, rows, len(NAMES)))
        self.B[:, :, 0] *= 100.0          # of ln K much is told
        # one leg is blind to z0 and to z1 - z2, another to k
        self.B[1, :, 1] = 0.0
        self.B[1, :, 3] = -self.B[1, :, 2]
        self.B[2, :, 0] = 0.0
        self.draw(rng)

    def draw(self, rng, constants=None):
        """Draw the noise, and the states where it matters not."""
        constants = np.tile(TRUTH, (len(self.A), 1)) if constants is None else constants
        self.b = np.einsum('jrc,jc->jr', self.B, constants) + rng.standard_normal(self.B.shape[:2])
        return self

    def border(self, j, about=None):
        """Return the border of a leg, linearised somewhere."""
        A, B, b = self.A[j], self.B[j], self.b[j]
        about = TRUTH + 0.1 * j if about is None else about
        free = B - A @ np.linalg.lstsq(A, B, rcond=None)[0]
        return Border(NAMES, np.array(about, float), free.T @ free,
                      free.T @ (b - B @ about), np.zeros(len(NAMES)), PRIOR, PRIOR)

    def borders(self):
        return [self.border(j) for j in range(len(self.A))]

    def batch(self, steps=STEPS, own=()):
        """
        Return value and covariance of the last leg's constants by one dense fit of all rows.

        own : (index, sigma) of constants that have an error of their own in each leg.
        """
        J, R, n = self.A.shape
        z, k, d = J * n, J * n + len(NAMES) - 1, J * n + len(NAMES) - 1 + J
        whole = np.zeros((J * R, d + J * len(own)))
        for j in range(J):
            rows = slice(j * R, (j + 1) * R)
            whole[rows, j * n:(j + 1) * n] = self.A[j]
            whole[rows, z:k] = self.B[j, :, 1:]
            whole[rows, k + j] = self.B[j, :, 0]
            for i, (which, _) in enumerate(own):
                whole[rows, d + j * len(own) + i] = self.B[j, :, which]
        more = np.zeros((len(PRIOR) - 1 + J - 1 + J * len(own), whole.shape[1]))
        more[range(4), range(z, k)] = 1 / PRIOR[1:]
        for j, step in enumerate(np.maximum(steps, 1e-7)):
            more[4 + j, [k + j, k + j + 1]] = -1 / step, 1 / step
        last = np.arange(J * len(own))
        more[4 + J - 1 + last, d + last] = 1 / np.tile([s for _, s in own], J)
        whole = np.concatenate([whole, more])
        Q, T = np.linalg.qr(whole)
        inverse = np.linalg.inv(T)
        x = inverse @ (Q.T @ np.concatenate([self.b.ravel(), np.zeros(len(more))]))
        at = [k + J - 1, *range(z, k)]
        return x[at], (inverse @ inverse.T)[np.ix_(at, at)]


USUAL = {'z3': 0.05}
NO_SCATTER = 1e-9, 1e-9, 1e-9       # of ln K, yaw and pitch between legs


def of(borders, steps=STEPS, usual=None):
    return joint(borders, steps, 'k', usual=usual)


def apart(a, b, covariance):
    return np.abs((a - b) / np.sqrt(np.diag(covariance))).max()


@pytest.fixture
def toy():
    return Toy(np.random.default_rng(1))


def test_legs_are_one_fit_of_all_rows(toy):
    found, (value, covariance) = of(toy.borders()), toy.batch()
    assert not found.disputed
    assert apart(found.value, value, covariance) < 1e-9
    assert np.abs(found.covariance / covariance - 1).max() < 1e-6      # small ones beside large
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((found.covariance - covariance) / np.outer(sigma, sigma)).max() < 1e-9


def test_a_leg_that_is_blind_alone_is_no_less_part_of_it(toy):
    blind = toy.borders()[1]
    size = np.linalg.eigvalsh(blind.information)
    assert (size[:2] < 1e-9 * size[-1]).all()
    without = of([b for j, b in enumerate(toy.borders()) if j != 1], STEPS[1:])
    assert of(toy.borders()).covariance[3, 3] < without.covariance[3, 3]


def test_errors_of_each_leg_alone_are_unknowns_of_the_fit(toy):
    own = {'z0': 0.3, 'z3': 0.05}
    value, covariance = toy.batch(own=[(NAMES.index(n), s) for n, s in own.items()])
    found = of([b.loosened(own) for b in toy.borders()])
    assert apart(found.value, value, covariance) < 1e-9


def test_linearisation_and_order_of_legs_are_no_matter(toy):
    moved = [toy.border(j, TRUTH - 0.2 * j) for j in range(LEGS)]
    a, b = of(toy.borders()), of(moved)
    assert apart(a.value, b.value, a.covariance) < 1e-9
    assert a.chi2 == pytest.approx(b.chi2, rel=1e-6)
    borders = toy.borders()
    one = of(borders, np.zeros(LEGS - 1))
    other = of([borders[j] for j in (3, 0, 4, 1, 2)], np.zeros(LEGS - 1))
    assert apart(one.value, other.value, one.covariance) < 1e-6
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-6)


def test_the_prior_counts_once(toy):
    # next to no data: what is left is the prior, not a fifth of its variance
    found = of([b.widened(1e5) for b in toy.borders()])
    assert np.sqrt(np.diag(found.covariance))[1:] == pytest.approx(PRIOR[1:], rel=1e-3)


def test_some_constants_of_a_leg_are_told_as_with_beliefs_about_the_rest(toy):
    whole = toy.border(0)
    believed = np.where(np.isin(NAMES, ('z1', 'z2')), 0.0, PRIOR**-2.0)
    H = whole.information + np.diag(believed)
    x = np.linalg.solve(H, whole.pull + whole.information @ whole.value)
    some = whole.only(('z1', 'z2'))
    C = np.linalg.inv(some.information)
    assert some.names == ('z1', 'z2')
    assert np.linalg.inv(H)[2:4, 2:4] == pytest.approx(C, rel=1e-9)
    assert some.value + C @ some.pull == pytest.approx(x[2:4], abs=1e-9)


def test_a_leg_without_information_changes_nothing(toy):
    borders = toy.borders()
    nothing = replace(borders[0], information=np.zeros((5, 5)), pull=np.zeros(5))
    a, b = of(borders), of([nothing, *borders], [0.1, *STEPS])
    assert apart(a.value, b.value, a.covariance) < 1e-9
    # freedom is a sum of some twenty shares since priors are weighed: alike but for rounding
    assert (a.freedom, a.chi2) == (pytest.approx(b.freedom, rel=1e-12),
                                   pytest.approx(b.chi2, rel=1e-6))


def test_sections_of_one_leg_are_one_leg(toy):
    """With a scatter between legs, which they do not have: as without any."""
    still = np.zeros(LEGS - 1)
    whole = of(toy.borders(), still)
    found = joint(toy.borders(), still, 'k', usual=USUAL, same=[True] * (LEGS - 1))
    assert apart(found.value, whole.value, whole.covariance) < 1e-6
    assert found.covariance == pytest.approx(whole.covariance, rel=1e-6)
    assert (found.chi2, found.freedom) == (whole.chi2, whole.freedom)
    scattered = of(toy.borders(), still, USUAL)
    assert scattered.covariance[4, 4] > 1.001 * whole.covariance[4, 4]


def test_chi_square_has_its_mean_and_variance():
    rng = np.random.default_rng(2)
    small = Toy(rng, states=6, rows=60)
    def drawn():
        constants = np.tile(TRUTH, (LEGS, 1))
        constants[:, 0] += np.concatenate([[0.0], np.cumsum(
            STEPS * rng.standard_normal(LEGS - 1))])
        return of(small.draw(rng, constants).borders(), usual=USUAL)
    found = [drawn() for _ in range(400)]
    freedom, chi2 = found[0].freedom, np.array([f.chi2 for f in found])
    # ranks 5, 3, 4, 5, 5 and 4 of the walk, less 9 unknowns
    # (priors take up a little of what these are told to)
    assert freedom == pytest.approx(22 + 4 - 9, abs=0.05)
    assert chi2.mean() == pytest.approx(freedom, abs=4 * np.sqrt(2 * freedom / 400))
    assert chi2.var() == pytest.approx(2 * freedom, rel=0.33)      # 4 sigmas of it
    # each of five constants in one of 300, and all together in one of 20
    assert np.mean([bool(f.disputed) for f in found]) < 0.035
    assert 0.03 < np.mean([f.factor > 1 for f in found]) < 0.07
    z = np.concatenate([f.deviation.ravel() for f in found])
    assert z[z != 0].std() == pytest.approx(1.0, abs=0.03)


def test_the_leg_and_the_constant_that_differ_are_named():
    rng = np.random.default_rng(3)
    small = Toy(rng, states=6, rows=40)
    constants = np.tile(TRUTH, (LEGS, 1))
    constants[3, 4] += 5.0
    borders = small.draw(rng, constants).borders()
    # the prior of that leg has given way, as it does where data gainsay it
    borders[3] = replace(borders[3], used=np.where(PRIOR == 1.0, 5.0, PRIOR))
    found = of(borders, usual=USUAL)
    assert found.disputed == ('z3',)
    assert np.argmax(np.abs(found.deviation[:, 4])) == 3
    # one of five off by 5: scattering by 5 / sqrt(5), the mean off by 1
    assert found.between['z3'] == pytest.approx(5 / np.sqrt(5), rel=0.5)
    assert abs(found.value[4] - TRUTH[4]) < 2 * np.sqrt(found.covariance[4, 4])
    assert np.abs((found.value - TRUTH) / np.sqrt(np.diag(found.covariance))).max() < 3.5


def test_what_no_constant_explains_widens_all():
    rng = np.random.default_rng(4)
    small = Toy(rng, states=6, rows=40)
    constants = TRUTH + 3.0 * rng.standard_normal((LEGS, 5))
    found = of(small.draw(rng, constants).borders(), usual=USUAL)
    assert found.disputed[0] == 'z3'
    assert found.factor > 1.5


def scale_and_yaw(yaw, *information):
    unit = np.full(2, np.inf)
    return Border(('k', 'yaw'), np.array([0.0, yaw]), np.diag(information), np.zeros(2),
                  np.zeros(2), unit, unit)


def test_a_leg_far_from_where_it_was_linearised_counts_less():
    # the first knows nothing of the yaw and was linearised 0.1 rad off: its scale is 0.5 % off
    legs = [scale_and_yaw(0.1, 1e12, 1e-2), scale_and_yaw(0.0, 1e8, 1e8)]
    found = joint(legs, [0.0], 'k', ('yaw',), ('k', 'yaw'))
    assert found.bent == pytest.approx([0.005, 0.0], abs=1e-9)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(1e-4, rel=1e-3)
    assert np.sqrt(joint(legs, [0.0], 'k').covariance[0, 0]) < 2e-6


def test_angles_about_half_a_turn_are_one():
    legs = [scale_and_yaw(yaw, 1e6, 1e6) for yaw in (np.pi - 1e-3, 1e-3 - np.pi)]
    found = joint(legs, [0.0], 'k', ('yaw',), ('yaw',))
    assert abs(found.value[1]) == pytest.approx(np.pi, abs=1e-9)
    assert not found.disputed


SHORT = {'duration': 200.0, 'imu_grade': 'industrial'}
SCALE, YAW = 'scale_factor', 'yaw_mounting_angle'


@pytest.fixture(scope='module')
def legs():
    """Return the truth, settings, and the smoother's results of three town drives."""
    drives = [made(**SHORT, seed=seed) for seed in (1, 2, 3)]
    steady = with_settings(drives[0][1], {'verdict.scale_drift_per_day': 0.0,
                                          'method': 'smoother'})
    return drives[0][0].truth, steady, [smooth(leg, c) for _, c, leg in drives]


def test_a_leg_of_the_smoother_is_what_its_border_and_its_beliefs_say(legs):
    for one in legs[2]:
        found = joint([one.border], [])
        for i, name in enumerate((SCALE, YAW, 'pitch_mounting_angle')):
            e = one.estimates[name]
            value, size = (np.log(e.value), e.value) if i == 0 else (e.value, 1.0)
            # sizes are of the vehicle's priors, of which a border has none
            of_sizes, = (s.effects[i] for s in one.sources if s.name == 'imperfection_sizes')
            sigma = np.sqrt(found.covariance[i, i] + MODEL_FLOOR[i]**2 + of_sizes @ of_sizes)
            assert sigma == pytest.approx(e.sigma / size, rel=1e-6)
            assert abs(found.value[i] - value) < 1e-3 * sigma


def test_legs_of_the_smoother_add_up_their_information(legs, monkeypatch):
    monkeypatch.setattr(several, 'SCATTER', NO_SCATTER)
    truth, config, results = legs
    whole = combine_legs(results, [0, 1, 2], config)
    # one size of each imperfection, whichever leg it is of
    used = np.max([b.used for b in several._of_one_vehicle([r.border for r in results])], axis=0)
    C = np.linalg.inv(sum(r.border.information for r in results) + np.diag(1 / used**2))
    sigma = np.hypot(np.sqrt(np.diag(C))[:3], MODEL_FLOOR)
    assert whole.estimates[SCALE].sigma / truth.scale == pytest.approx(sigma[0], rel=1e-3)
    assert whole.estimates[YAW].sigma == pytest.approx(sigma[1], rel=1e-3)
    for name, true in ((SCALE, truth.scale), (YAW, truth.yaw)):
        e = whole.estimates[name]
        assert abs(e.value - true) < 3.3 * e.sigma, name
        assert e.sigma < min(r.estimates[name].sigma for r in results), name
    assert whole.estimates['scale_ratio'].sigma / whole.estimates['scale_ratio'].value \
        == pytest.approx(whole.estimates[SCALE].sigma / whole.estimates[SCALE].value)
    assert whole.estimates['gyro_bias_z'] == results[2].estimates['gyro_bias_z']


def test_sources_of_legs_combined_make_their_sigma(legs):
    _, config, results = legs
    whole = combine_legs(results, [0, 1, 2], config)
    total = sum(s.effects @ s.effects.T for s in whole.sources)
    sigma = [whole.estimates[n].sigma for n in whole.parameters]
    sigma[0] /= whole.estimates[SCALE].value
    assert np.sqrt(np.diag(total)) == pytest.approx(sigma)
    assert [s.name for s in whole.sources if not s.shared] == ['legs', 'model']
    assert 'fix_latency' in {s.name for s in whole.sources}
    assert 'heading' not in {s.name for s in whole.sources}       # there was none


def test_a_shared_source_is_what_an_error_of_that_belief_does(legs, monkeypatch):
    monkeypatch.setattr(several, 'SCATTER', NO_SCATTER)
    _, config, results = legs

    def combined(name, sigmas):
        at = results[0].border.names.index(name)
        moved = [r.border.centre + sigmas * r.border.used[at] * np.eye(len(r.border.names))[at]
                 for r in results]
        return combine_legs([replace(r, border=replace(r.border, centre=c)) for r, c in
                             zip(results, moved, strict=True)], [0, 1, 2], config)
    before, after = (combined('gnss_delay', sigmas) for sigmas in (0.0, 1.0))
    (effect,) = [s.effects[:, 0] for s in before.sources if s.name == 'fix_latency']
    pitch = 'pitch_mounting_angle'
    assert after.estimates[pitch].value - before.estimates[pitch].value \
        == pytest.approx(effect[2], rel=1e-3)


def test_a_scale_that_walks_is_that_of_the_last_leg(legs):
    _, config, results = legs
    day = 86400 * 10**9
    far = with_settings(config, {'verdict.scale_drift_per_day': 0.1})
    whole, last = combine_legs(results, [2 * day, 0, day], far), results[0]
    # 10 % a day: days before say nothing of it
    assert whole.estimates[SCALE].value == pytest.approx(last.estimates[SCALE].value, rel=1e-4)
    assert whole.estimates[SCALE].sigma > 0.9 * last.estimates[SCALE].sigma
    # but of the yaw they do
    assert whole.estimates[YAW].sigma < 0.8 * last.estimates[YAW].sigma


def test_a_leg_widened_for_its_model_counts_less(legs, monkeypatch):
    monkeypatch.setattr(several, 'SCATTER', NO_SCATTER)
    _, config, results = legs
    doubted = replace(results[0], border=results[0].border.widened(2.0))
    sure, unsure = (combine_legs([one, one], [0, 1], config) for one in (results[0], doubted))
    assert unsure.estimates[SCALE].sigma == pytest.approx(2 * sure.estimates[SCALE].sigma, rel=0.1)


def test_a_wheel_that_changes_on_the_way_is_in_the_border_too(legs):
    _, config, results = legs
    run = SimpleNamespace(distance=1000.0, nominal=0.0, config=config,
                          wheel_slips=replace(NO_SLIPS, change=8e-4))
    loose = with_wheel_change(results[0], run)
    scale = loose.estimates[SCALE]
    assert scale.sigma / scale.value > 2e-4
    variance = joint([loose.border], []).covariance[0, 0] + MODEL_FLOOR[0]**2
    of_sizes, = (s.effects[0] for s in loose.sources if s.name == 'imperfection_sizes')
    assert np.sqrt(variance + of_sizes @ of_sizes) == pytest.approx(scale.sigma / scale.value,
                                                                    rel=1e-6)


def test_a_dispute_names_leg_and_parameter(legs):
    _, config, results = legs
    odd = results[1].border
    changed = replace(odd, value=odd.value + 0.01 * (np.arange(len(odd.names)) == 1))
    whole = combine_legs([results[0], replace(results[1], border=changed), results[2]],
                         [0, 1, 2], config, [4, 7, 9])
    (said,) = [r.text for r in whole.reasons if r.code is Code.LEGS_DISAGREE]
    assert said.startswith('yaw_mounting_angle: the scatter of 3 legs')
    assert '; leg 7 differs most (+' in said
    assert whole.estimates[YAW].sigma > 0.002
    # and what is not disputed is as sharp as before
    assert whole.estimates[SCALE].sigma == pytest.approx(
        combine_legs(results, [0, 1, 2], config).estimates[SCALE].sigma, rel=0.1)


def test_sections_of_a_leg_that_disagree_name_the_largest_deviation(legs):
    _, config, (one, other, _) = legs
    at = np.arange(len(other.border.names)) == other.border.names.index('odometer_delay')
    changed = replace(other.border, value=other.border.value + 0.1 * at)
    whole = combine_legs([one, replace(other, border=changed)], [0, 0], config)
    (text,) = [r.text for r in whole.reasons if r.code is Code.LEGS_DISAGREE
               and r.text.startswith('the scatter of 2 legs is ')]
    assert re.search('; odometer_delay differs most [(][0-9.]+ sigma[)]$', text)


def test_small_deviations_are_no_cause():
    found = SimpleNamespace(names=('scale_factor', 'odometer_delay', 'gnss_delay'), between={
        'scale_factor': 1e-5}, deviation=np.array([[9, 1, 0], [0, -2.5, 1], [0, 1, -1.0]]))
    assert several._largest(found, [4, 7, 9]) == (
        'no parameter alone explains it: odometer_delay of leg 7 differs most (2.5 sigma)')


@pytest.mark.parametrize('off', [1e-3, -3e-3])
def test_two_legs_whose_scales_differ_dispute_it(legs, off):
    _, config, (one, other, _) = legs
    scale = np.arange(len(other.border.names)) == 0
    changed = replace(other.border, value=other.border.value + off * scale)
    whole = combine_legs([one, replace(other, border=changed)], [0, 1], config)
    (said,) = [r.text for r in whole.reasons if r.code is Code.LEGS_DISAGREE]
    assert said.startswith('scale_factor: the scatter of 2 legs')
    e = whole.estimates[SCALE]
    assert 0.3 * abs(off) < e.sigma / e.value < 1.5 * abs(off)
    assert not any(r.code is Code.LEGS_DISAGREE
                   for r in combine_legs([one, other], [0, 1], config).reasons)


def leg_result(method, number, *codes):
    return LegResult(
        start_ns=number * 10**12, stop_ns=number * 10**12 + 10**11, distance=1e3, duration=100.0,
        imu_samples=1, pulses=1, fixes=1, rejected_fixes=0,
        reasons=tuple(Reason(c, c.name) for c in codes), methods={'smoother': method},
        C_bi=np.eye(3))


def test_a_yaw_that_no_leg_tells_may_come_of_all(legs):
    _, config, results = legs

    def refused(one):
        """Return a result whose yaw is told to 0.8 deg only, as on a drive straight on."""
        loose = one.border.loosened({YAW: 0.014})
        return replace(one, border=loose, estimates=one.estimates | {
            YAW: Estimate(None, None, 'rad')}, reasons=(Reason(Code.YAW_NOT_DETERMINED, 'no'),))
    whole = combine([leg_result(refused(one), i) for i, one in enumerate(results)], config)
    assert whole.estimates[YAW].sigma == pytest.approx(0.014 / np.sqrt(3), rel=0.01)
    assert Code.YAW_NOT_DETERMINED not in {r.code for r in whole.reasons}
    two = combine([leg_result(refused(one), i) for i, one in enumerate(results[:2])], config)
    assert two.estimates[YAW].value is None
    assert [r.text[:4] for r in two.reasons if r.code is Code.YAW_NOT_DETERMINED] == ['yaw ']
