# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs of the smoother combined by marginal information: sources, disputes."""

from dataclasses import replace
import re
from types import SimpleNamespace

from legs_to_combine import leg_result, moved, NO_SCATTER
import numpy as np
import pytest
from smoother_legs import made, smoothed

from odocal_ros.calib.joint import fit_jointly
from odocal_ros.calib.result import Estimate
from odocal_ros.calib.slip import NO_SLIPS
from odocal_ros.estimator import several
from odocal_ros.estimator.result.remarks import MODEL_FLOOR
from odocal_ros.estimator.several import combine_legs
from odocal_ros.pipeline.beyond_model import with_wheel_change
from odocal_ros.pipeline.combination import combine
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import with_settings

pytestmark = pytest.mark.slow
SHORT = {'duration': 200.0, 'imu_grade': 'industrial'}
SCALE, YAW = 'scale_factor', 'yaw_mounting_angle'


@pytest.fixture(scope='module')
def legs():
    drive, config, _ = made(**SHORT, seed=1)
    steady = with_settings(config, {'verdict.scale_drift_per_day': 0.0, 'method': 'smoother'})
    return drive.truth, steady, [smoothed(**SHORT, seed=seed)[1] for seed in (1, 2, 3)]


def by_marginal(one, i):
    """Return value and sigma of ln K, yaw or pitch from the marginal information of a result."""
    found = fit_jointly([one.marginal], [])
    # sizes belong to the priors of the vehicle, which marginal information does not include
    of_sizes, = (s.effects[i] for s in one.sources if s.name == 'imperfection_sizes')
    return found.value[i], np.sqrt(
        found.covariance[i, i] + MODEL_FLOOR[i]**2 + of_sizes @ of_sizes)


def test_marginal_information_and_priors_determine_a_leg_of_the_smoother(legs):
    for one in legs[2]:
        for i, name in enumerate((SCALE, YAW, 'pitch_mounting_angle')):
            e, (found, sigma) = one.estimates[name], by_marginal(one, i)
            value, size = (np.log(e.value), e.value) if i == 0 else (e.value, 1.0)
            assert sigma == pytest.approx(e.sigma / size, rel=1e-6)
            assert abs(found - value) < 1e-3 * sigma


def test_information_of_smoother_legs_adds_up(legs, monkeypatch):
    monkeypatch.setattr(several, 'SCATTER', NO_SCATTER)
    truth, config, results = legs
    whole = combine_legs(results, [0, 1, 2], config)
    # one size of each imperfection in all legs
    shared = several._share_sizes([r.marginal for r in results])
    used = np.max([b.relaxed_sigma for b in shared], axis=0)
    C = np.linalg.inv(sum(r.marginal.information for r in results) + np.diag(1 / used**2))
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


def test_sources_of_combined_legs_sum_to_their_sigma(legs):
    _, config, results = legs
    whole = combine_legs(results, [0, 1, 2], config)
    total = sum(s.effects @ s.effects.T for s in whole.sources)
    sigma = [whole.estimates[n].sigma for n in whole.parameters]
    sigma[0] /= whole.estimates[SCALE].value
    assert np.sqrt(np.diag(total)) == pytest.approx(sigma)
    assert [s.name for s in whole.sources if not s.shared] == ['legs', 'model']
    assert 'fix_latency' in {s.name for s in whole.sources}
    assert 'heading' not in {s.name for s in whole.sources}       # no heading sensor


def test_common_source_equals_the_effect_of_an_error_of_its_prior(legs, monkeypatch):
    monkeypatch.setattr(several, 'SCATTER', NO_SCATTER)
    _, config, results = legs

    def combined(name, sigmas):
        at = results[0].marginal.names.index(name)
        unit = np.eye(len(results[0].marginal.names))[at]
        moved = [m.prior_mean + sigmas * m.relaxed_sigma[at] * unit
                 for m in (r.marginal for r in results)]
        return combine_legs([replace(r, marginal=replace(r.marginal, prior_mean=c)) for r, c in
                             zip(results, moved, strict=True)], [0, 1, 2], config)
    before, after = (combined('gnss_delay', sigmas) for sigmas in (0.0, 1.0))
    (effect,) = [s.effects[:, 0] for s in before.sources if s.name == 'fix_latency']
    pitch = 'pitch_mounting_angle'
    assert after.estimates[pitch].value - before.estimates[pitch].value \
        == pytest.approx(effect[2], rel=1e-3)


def test_random_walk_scale_is_the_scale_of_the_last_leg(legs):
    _, config, results = legs
    day = 86400 * 10**9
    far = with_settings(config, {'verdict.scale_drift_per_day': 0.1})
    whole, last = combine_legs(results, [2 * day, 0, day], far), results[0]
    # with a walk of 10 % per day, earlier days have no scale information
    assert whole.estimates[SCALE].value == pytest.approx(last.estimates[SCALE].value, rel=1e-4)
    assert whole.estimates[SCALE].sigma > 0.9 * last.estimates[SCALE].sigma
    # but they have yaw information
    assert whole.estimates[YAW].sigma < 0.8 * last.estimates[YAW].sigma


def test_marginal_information_includes_a_wheel_change_within_the_leg(legs):
    _, config, results = legs
    run = SimpleNamespace(distance=1000.0, nominal_scale=0.0, config=config,
                          wheel_slips=replace(NO_SLIPS, change=8e-4))
    loose = with_wheel_change(results[0], run)
    scale = loose.estimates[SCALE]
    assert scale.sigma / scale.value > 2e-4
    assert by_marginal(loose, 0)[1] == pytest.approx(scale.sigma / scale.value, rel=1e-6)


def disputes(whole):
    return [r.text for r in whole.reasons if r.code is Code.LEGS_DISAGREE]


def test_dispute_names_leg_and_parameter(legs):
    _, config, results = legs
    whole = combine_legs([results[0], moved(results[1], YAW, 0.01), results[2]],
                         [0, 1, 2], config, [4, 7, 9])
    (text,) = disputes(whole)
    assert text.startswith('yaw_mounting_angle: the scatter of 3 legs')
    assert '; leg 7 differs most: +' in text
    assert whole.estimates[YAW].sigma > 0.002
    # undisputed values keep their sigma
    assert whole.estimates[SCALE].sigma == pytest.approx(
        combine_legs(results, [0, 1, 2], config).estimates[SCALE].sigma, rel=0.1)


def test_disagreeing_sections_name_the_largest_deviation_unless_it_is_small(legs):
    _, config, (one, other, _) = legs
    whole = combine_legs([one, moved(other, 'odometer_delay', 0.1)], [0, 0], config)
    (text,) = [x for x in disputes(whole) if x.startswith('the scatter of 2 legs is ')]
    assert re.search('; odometer_delay differs most [(][0-9.]+ sigma[)]$', text)
    found = SimpleNamespace(names=('scale_factor', 'odometer_delay', 'gnss_delay'), scatter={
        'scale_factor': 1e-5}, deviation=np.array([[9, 1, 0], [0, -2.5, 1], [0, 1, -1.0]]))
    assert several._largest_deviation(found, [4, 7, 9]) == (
        'no parameter alone explains it: odometer_delay of leg 7 differs most (2.5 sigma)')


@pytest.mark.parametrize('off', [1e-3, -3e-3])
def test_two_legs_with_different_scales_dispute_the_scale(legs, off):
    _, config, (one, other, _) = legs
    whole = combine_legs([one, moved(other, SCALE, off)], [0, 1], config)
    (text,) = disputes(whole)
    assert text.startswith('scale_factor: the scatter of 2 legs')
    e = whole.estimates[SCALE]
    assert 0.3 * abs(off) < e.sigma / e.value < 1.5 * abs(off)
    assert not disputes(combine_legs([one, other], [0, 1], config))


def test_yaw_undetermined_in_each_leg_may_be_determined_by_all_legs(legs):
    _, config, results = legs

    def refused(one):
        """Return a result with a yaw sigma of only 0.8 deg, as on a straight drive."""
        loose = one.marginal.with_leg_errors({YAW: 0.014})
        return replace(one, marginal=loose, estimates=one.estimates | {
            YAW: Estimate(None, None, 'rad')}, reasons=(Reason(Code.YAW_NOT_DETERMINED, 'no'),))
    whole = combine([leg_result(refused(one), i) for i, one in enumerate(results)], config)
    assert whole.estimates[YAW].sigma == pytest.approx(0.014 / np.sqrt(3), rel=0.01)
    assert Code.YAW_NOT_DETERMINED not in {r.code for r in whole.reasons}
    two = combine([leg_result(refused(one), i) for i, one in enumerate(results[:2])], config)
    assert two.estimates[YAW].value is None
    assert [r.text[:4] for r in two.reasons if r.code is Code.YAW_NOT_DETERMINED] == ['yaw ']
