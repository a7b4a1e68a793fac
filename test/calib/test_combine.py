# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Several legs: independent errors average down, common errors do not, disagreement widens."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.combine import combine_method
from odocal_ros.calib.result import Estimate, LegResult, MethodResult, Source
from odocal_ros.pipeline.combination import combine
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
CONFIG = Config()
LEGS = count(1)
SCALE, YAW, PITCH = PARAMETERS
NOISE, HEADING = 1e-4, 1e-3       # of ln K and yaw; of yaw only


def method(scale=0.02, yaw=0.01, noise=NOISE, heading=HEADING, refused=(), reasons=()):
    sources = (Source('fix_start', np.diag([noise, noise, 2 * noise])),
               Source('initial_heading', np.array([[0.0], [heading], [0.0]]), shared=True),
               Source('initial_level', np.array([[0.0], [0.0], [5e-4]]), shared=True))
    sigma = [noise, np.hypot(noise, heading), np.hypot(2 * noise, 5e-4)]
    estimates = {SCALE: Estimate(scale, scale * sigma[0], 'm/pulse'),
                 YAW: Estimate(yaw, sigma[1], 'rad'), PITCH: Estimate(0.007, sigma[2], 'rad'),
                 'scale_ratio': Estimate(scale / 0.019, scale / 0.019 * sigma[0], '1')}
    for name in refused:
        estimates[name] = Estimate(None, None, estimates[name].unit)
    return MethodResult('two_point', tuple(reasons), estimates, PARAMETERS, sources)


def leg(result, *codes):
    start_ns = 1_000 * next(LEGS)        # consecutive legs
    return LegResult(start_ns, start_ns + 900, 1e3, 100.0, 1, 1, 1, 0,
                     tuple(Reason(c, c.name) for c in codes),
                     {'two_point': result} if result else {}, C_bi=np.eye(3))


@pytest.mark.parametrize('n', [2, 5, 16])
def test_independent_errors_average_down_and_common_errors_remain(n):
    e = combine_method('two_point', [method()] * n).estimates
    assert e[SCALE].value == pytest.approx(0.02)
    assert e[SCALE].sigma / 0.02 == pytest.approx(NOISE / np.sqrt(n))
    assert e[YAW].sigma == pytest.approx(np.hypot(NOISE / np.sqrt(n), HEADING))
    assert e[PITCH].sigma == pytest.approx(np.hypot(2 * NOISE / np.sqrt(n), 5e-4))
    assert e['scale_ratio'].value == pytest.approx(0.02 / 0.019)
    assert e['scale_ratio'].sigma / e['scale_ratio'].value == pytest.approx(NOISE / np.sqrt(n))


@pytest.mark.parametrize(('legs', 'mean'), [
    # more accurate legs have more weight
    ([method(yaw=0.010), method(yaw=0.0102, noise=NOISE / 3)], 0.0102 * 0.9 + 0.010 * 0.1),
    # -1, 1 and 2 times 1e-4 from half a turn
    ([method(yaw=yaw) for yaw in (np.pi - 1e-4, 1e-4 - np.pi, 2e-4 - np.pi)], 2e-4 / 3 - np.pi)])
def test_mean_is_weighted_and_may_be_near_half_a_turn(legs, mean):
    combined = combine_method('two_point', legs)
    assert combined.reasons == ()
    assert combined.estimates[YAW].value == pytest.approx(mean, abs=1e-12)


def test_mean_is_never_worse_than_its_best_leg():
    # one leg has a small independent error and a large heading error; the other the opposite
    legs = [method(noise=NOISE / 10, heading=1e-2), method(noise=NOISE, heading=1e-4)]
    whole = combine_method('two_point', legs).estimates[YAW]
    assert whole.sigma <= legs[1].estimates[YAW].sigma * (1 + 1e-9)
    # with weights by independent errors only it is 1e-2, as of the first leg
    assert whole.sigma < 1.5e-4


def test_common_error_with_opposite_effects_cancels():
    """An antenna offset with opposite effects on the outward and return legs leaves the mean."""
    one = method(heading=0.0)
    there, back = (replace(one, sources=(*one.sources, Source(
        'antenna_lever_arm', np.array([[arm], [0.0], [0.0]]), shared=True)))
        for arm in (1e-2, -1e-2))
    for legs, shared in (([there, back], 0.0), ([there, there], 1e-2)):
        sigma = combine_method('two_point', legs).estimates[SCALE].sigma
        assert sigma / 0.02 == pytest.approx(np.hypot(NOISE / np.sqrt(2), shared))


def test_scatter_beyond_the_sigmas_is_named_and_widens_the_sigma():
    legs = [method(scale=0.02 * (1 + d)) for d in (-1e-3, 0.0, 1e-3)]
    whole = combine_method('two_point', legs)
    # chi-square 200 with two degrees of freedom: ten times the scatter expected from the sigmas
    assert whole.estimates[SCALE].sigma / 0.02 == pytest.approx(10 * NOISE / np.sqrt(3), rel=1e-3)
    assert [r.code for r in whole.reasons] == [Code.LEGS_DISAGREE]
    assert whole.reasons[0].text == ('scale_factor: the scatter of 3 legs is 10.0 times their '
                                     'uncertainties')


def test_scatter_by_a_common_error_or_a_new_bias_is_not_a_disagreement():
    """The heading error may affect two legs differently; the difference is accounted for."""
    legs = [method(yaw=0.01 + heading, heading=heading) for heading in (1e-3, -1e-3)]
    assert combine_method('two_point', legs).reasons == ()
    # legs drawn by their own sigmas disagree in one of twenty cases
    rng, named = np.random.default_rng(5), 0
    for _ in range(400):
        legs = [method(scale=0.02 * np.exp(NOISE * z)) for z in rng.standard_normal(4)]
        named += any(r.text.startswith('scale') for r in combine_method('two_point', legs).reasons)
    assert 0.02 < named / 400 < 0.09      # 5 % +- 3 * 1.1 %, and 1 % for the approximation
    # two power-ups have two accelerometer biases: accounted for, but not averaged down
    def pitched(value):
        one = method()
        return replace(one, estimates=one.estimates | {PITCH: Estimate(value, 5e-4, 'rad')})
    whole = combine_method('two_point', [pitched(0.0065), pitched(0.0075)])
    assert whole.reasons == ()
    assert whole.estimates[PITCH].sigma > 5e-4
    assert combine_method('two_point', [pitched(0.0), pitched(0.005)]).reasons != ()


def weekly(scales):
    week = 7 * 86_400 * 10**9
    return combine([replace(leg(method(scale=scale)), start_ns=k * week, stop_ns=k * week + 900)
                    for k, scale in enumerate(scales)], CONFIG)


WALK = CONFIG.verdict.scale_drift_per_day * 7**0.5      # sigma of ln K in a week


def test_random_walk_scale_is_the_scale_of_the_last_leg():
    """Two legs: the first constrains the last scale by OWN and the walk, the last by OWN."""
    first, last = NOISE**2 + WALK**2, NOISE**2
    e = weekly([0.02, 0.02 * np.exp(1e-4)]).estimates[SCALE]
    assert np.log(e.value / 0.02) == pytest.approx(1e-4 * first / (first + last))
    assert e.sigma / e.value == pytest.approx(np.sqrt(first * last / (first + last)))


def test_sigma_of_a_random_walk_scale_holds_for_drawn_legs():
    """1000 draws of six weeks: variance within 5 * sqrt(2/1000); one in twenty disagrees."""
    rng, z, named = np.random.default_rng(8), [], 0
    for _ in range(1000):
        true = np.cumsum(WALK * rng.standard_normal(6))
        whole = weekly(0.02 * np.exp(true + NOISE * rng.standard_normal(6)))
        e = whole.estimates[SCALE]
        z.append((np.log(e.value / 0.02) - true[-1]) * e.value / e.sigma)
        named += Code.LEGS_DISAGREE in {r.code for r in whole.reasons}
    assert 0.88 < np.sqrt(np.mean(np.square(z))) < 1.11
    assert 0.02 < named / 1000 < 0.08     # 5 % +- 3 * 0.7 %, and 1 % for the approximation


def test_leg_without_a_yaw_still_gives_its_scale():
    whole = combine_method('two_point', [method(refused=[YAW]), method()])
    assert whole.estimates[SCALE].sigma / 0.02 == pytest.approx(NOISE / np.sqrt(2))
    assert whole.estimates[YAW].sigma == pytest.approx(np.hypot(NOISE, HEADING))
    nobody = combine_method('two_point', [method(refused=[YAW])] * 2)
    assert nobody.estimates[YAW].value is None
    assert nobody.estimates[SCALE].value is not None


def test_combined_sources_and_budget_sum_to_the_combined_sigma():
    one = method()
    assert combine_method('two_point', [one]) is one
    whole = combine_method('two_point', [one, method(noise=2 * NOISE)])
    total = sum(s.effects @ s.effects.T for s in whole.sources)
    for i, (name, scale) in enumerate(((SCALE, 0.02), (YAW, 1.0), (PITCH, 1.0))):
        by_name = np.linalg.norm([row[name] for row in whole.details['budget'].values()])
        assert [np.sqrt(total[i, i]) * scale, by_name] == pytest.approx(
            [whole.estimates[name].sigma] * 2)
    assert {s.name for s in whole.sources if s.shared} == {'initial_heading', 'initial_level'}
    assert set(whole.details['budget']) == {s.name for s in whole.sources}
    assert all(abs(rho) <= 1 + 1e-12 for rho in whole.details['correlation'].values())


def test_rejected_leg_is_excluded_and_named_unless_all_are_rejected():
    bad = leg(method(scale=0.05), Code.IMU_GAP)
    whole = combine([leg(method()), bad, leg(method())], CONFIG)
    assert whole.estimates[SCALE].value == pytest.approx(0.02)
    assert whole.verdict.value == 'caution'
    assert [r.text for r in whole.reasons if r.code is Code.LEG_REJECTED] == [
        'leg 2: rejected and not used: IMU_GAP']
    assert len(whole.legs) == 3
    whole = combine([leg(method(), Code.IMU_GAP), leg(method(), Code.TRACK_MISMATCH)], CONFIG)
    assert whole.verdict.value == 'rejected'
    assert whole.estimates[SCALE].value == pytest.approx(0.02)
    assert {Code.IMU_GAP, Code.TRACK_MISMATCH} <= {r.code for r in whole.reasons}
    whole = combine([leg(None)], CONFIG)
    assert whole.verdict.value == 'rejected'
    assert Code.NO_METHOD in {r.code for r in whole.reasons}
    assert whole.estimates == {}
    assert whole.imu_rotation_rpy is None


def test_too_few_legs_are_a_caution_and_limits_apply_to_the_combination():
    config = with_settings(CONFIG, {'verdict.min_legs': 3})
    whole = combine([leg(method()) for _ in range(2)], config)
    assert [r.text for r in whole.reasons] == ['2 usable legs; required: 3']
    assert whole.verdict.value == 'caution'
    assert combine([leg(method()) for _ in range(3)], config).reasons == ()
    wide = method(noise=1.5e-3, heading=0.0, reasons=[Reason(Code.SCALE_SIGMA_TOO_LARGE, 'leg')])
    assert combine([leg(wide)], CONFIG).verdict.value == 'caution'
    assert combine([leg(wide) for _ in range(4)], CONFIG).reasons == ()


def test_rotation_is_the_mounting_times_the_nominal_mounting():
    turned = replace(leg(method()), C_bi=np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    rpy = combine([turned], CONFIG).imu_rotation_rpy
    assert rpy[2] == pytest.approx(np.pi / 2 + 0.01)


def test_drive_given_twice_counts_once():
    one, separate = leg(method()), leg(method())
    again = replace(separate, start_ns=one.start_ns + 100, stop_ns=one.stop_ns + 100)
    whole = combine([one, again], CONFIG)
    assert Code.LEGS_OVERLAP in {r.code for r in whole.reasons}
    assert whole.estimates[SCALE].sigma == one.methods['two_point'].estimates[SCALE].sigma
    assert Code.LEGS_OVERLAP not in {r.code for r in combine([one, separate], CONFIG).reasons}
