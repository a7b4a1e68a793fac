# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which method gives which value; methods that differ, and legs of different vehicles."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.calib import choice
from odocal_ros.calib.result import Estimate, LegResult, MethodResult, Source
from odocal_ros.pipeline.combination import combine, inconsistent_legs
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.levels import REMARK_SIGMAS

NO_YAW = Reason(Code.YAW_NOT_DETERMINED, 'no turns')
ALL = with_settings(Config(), {'method': 'all'})
REFUSED = Reason(Code.CHORD_TOO_SHORT, 'a loop')
DEG = np.pi / 180
LIMIT = REMARK_SIGMAS * 2**0.5 * 1e-3       # between two scales of method()


def method(name, scale=2.0, yaw=0.01, reasons=()):
    """Return a result with a scale of sigma 1e-3 and a yaw of sigma 1e-4 rad."""
    sigma = None if scale is None else 1e-3
    return MethodResult(name, tuple(reasons), {
        'scale_factor': Estimate(scale, sigma, 'm/pulse'),
        'scale_ratio': Estimate(None, None, '1'),
        'yaw_mounting_angle': Estimate(yaw, None if yaw is None else 1e-4, 'rad')},
        ('scale_factor', 'yaw_mounting_angle'))


def several(*methods):
    return {m.name: m for m in methods}


def chosen(methods, setting, name='scale_factor'):
    estimates, giving = choice.choose(methods, setting)
    return estimates[name].value, giving


def test_each_value_comes_from_the_first_method_that_is_not_rejected():
    ends, refused = method('two_point'), method('two_point', None, None, [REFUSED])
    methods = several(ends, method('smoother', 2.1, None, [NO_YAW]))
    assert chosen(methods, 'all') == (2.1, ('smoother', 'two_point'))
    assert choice.choose(methods, 'all')[0]['yaw_mounting_angle'].method == 'two_point'
    fell = method('smoother', 2.1, reasons=[REFUSED])
    assert chosen(several(fell, ends), 'auto')[0] == 2.0
    # all methods are rejected; only one is required
    assert chosen(several(fell, refused), 'auto') == (2.1, ('smoother',))
    assert chosen(several(method('smoother', 2.1), refused), 'two_point') == (None, ('two_point',))
    assert choice.choose(several(ends), 'wheels') == ({}, ())


def test_end_points_do_not_give_a_pitch_that_the_smoother_cannot_determine():
    methods = several(*(replace(one, estimates=one.estimates | {
        'pitch_mounting_angle': Estimate(pitch, pitch and 1e-3, 'rad')}) for one, pitch in (
            (method('smoother'), None), (method('two_point'), 0.02))))
    assert chosen(methods, 'auto', 'pitch_mounting_angle')[0] is None
    assert chosen(methods, 'two_point', 'pitch_mounting_angle')[0] == 0.02


@pytest.mark.parametrize(('setting', 'run'), [
    ('two_point', ('two_point',)), ('wheels', ('smoother', 'two_point')),
    ('patent', ('smoother', 'two_point')), ('auto', ('smoother', 'two_point')),
    ('all', ('smoother', 'two_point'))])
def test_two_point_is_always_computed_for_marks_of_the_operator(setting, run):
    assert choice.computed_methods(setting) == set(run)


def test_reasons_about_a_value_from_another_method_are_not_reported():
    fell = method('smoother', 2.1, None, [NO_YAW])
    both, _ = choice.choose(several(fell, method('two_point')), 'all')
    alone, _ = choice.choose(several(fell), 'all')
    assert choice.relevant_reasons([NO_YAW, REFUSED], 'smoother', both) == (REFUSED,)
    assert choice.relevant_reasons([NO_YAW, REFUSED], 'smoother', alone) == (NO_YAW, REFUSED)


def test_rejected_method_is_named_if_a_later_method_gives_the_value():
    fell = method('smoother', reasons=[NO_YAW, REFUSED, Reason(Code.NOT_CONVERGED, 'more')])
    found, = choice.rejected_method_reasons(several(method('two_point'), fell), 'auto')
    assert found.code is Code.METHOD_REJECTED
    assert found.remedy.endswith('which may not detect this problem.')
    assert found.text == 'smoother is not used, because of CHORD_TOO_SHORT: a loop'
    # reported by the leg; after the method that gives the value; no method gives it; not required
    assert choice.rejected_method_reasons(several(method('two_point'), fell), 'auto',
                                          {REFUSED.code}) == []
    loop = method('two_point', reasons=[REFUSED])
    assert choice.rejected_method_reasons(several(loop, method('smoother')), 'auto') == []
    assert choice.rejected_method_reasons(several(loop, fell), 'auto') == []
    assert choice.rejected_method_reasons(several(method('two_point'), fell), 'two_point') == []
    # a missing second wheel is not a fault of the drive
    none = method('smoother', None, None, [Reason(Code.NO_METHOD, 'one wheel')])
    assert choice.rejected_method_reasons(several(none, method('two_point')), 'all') == []


@pytest.mark.parametrize(('other', 'text', 'cause'), [
    ({'scale': 2.0 + 1.01 * LIMIT}, 'scale: two_point minus smoother is +0.214 % (3.0 sigma; '
     'limit 3)',
     'marks'),
    ({'scale': 1.9}, 'is -5 % (', 'marks'), ({'yaw': 0.01 + 5e-3}, '+0.286 deg', 'heading'),
    ({'scale': 2.0 + 0.99 * LIMIT}, None, ''), ({'scale': 3.0, 'reasons': [REFUSED]}, None, '')])
def test_methods_that_differ_beyond_their_sigmas_are_named_with_the_cause(other, text, cause):
    found = choice.disagreements(several(method('smoother'), method('two_point', **other)))
    assert [r.code for r in found] == [Code.METHODS_DISAGREE] * bool(text)
    assert all(text in r.text and cause in r.text for r in found)


def leg(number, *methods, reasons=()):
    start = number * 3600 * 10**9
    return LegResult(start, start + 10**11, 1000.0, 100.0, 10_000, 5000, 500, 0, tuple(reasons),
                     several(*methods), C_bi=np.eye(3))


def test_leg_is_accepted_by_one_method_unless_the_setting_requires_another():
    one = leg(1, method('two_point', None, None, [REFUSED]), method('smoother'))
    assert one.verdict is Verdict.ACCEPTED
    whole = combine([one], ALL)
    assert whole.verdict is Verdict.ACCEPTED
    assert whole.estimates['scale_factor'].method == 'smoother'
    assert REFUSED not in whole.reasons
    assert REFUSED in whole.methods['two_point'].reasons
    one = leg(1, method('two_point', reasons=[REFUSED]), method('smoother'))
    assert replace(one, deciding=('two_point',)).verdict is Verdict.REJECTED


def test_method_combines_only_the_legs_it_accepts():
    legs = [leg(1, method('two_point', 2.0), method('smoother', 2.02)),
            leg(2, method('two_point', 2.0), method('smoother', None, None, [REFUSED]))]
    whole = combine(legs, ALL)
    assert whole.estimates['scale_factor'].value == 2.02
    assert whole.verdict is Verdict.CAUTION
    assert [r.text for r in whole.reasons] == ['leg 2: not used for smoother: a loop']


def test_method_rejected_on_every_leg_stays_rejected_in_the_combination():
    legs = [leg(i, method('two_point', 2.0, reasons=[REFUSED])) for i in (1, 2)]
    whole = combine(legs, Config())
    assert whole.verdict is Verdict.REJECTED
    assert whole.methods['two_point'].verdict is Verdict.REJECTED


def test_rejection_of_a_leg_or_of_its_method_is_reported_once():
    fell = Reason(Code.ODOMETER_REVERSED, 'by the method')
    rejected = leg(1, method('smoother', reasons=[fell]), method('two_point'),
                   reasons=[Reason(Code.ODOMETER_REVERSED, 'by the leg')])
    text, = (r.text for r in combine([rejected, leg(2, method('smoother'))], ALL).reasons
             if r.code is Code.LEG_REJECTED)
    assert text == 'leg 1: rejected and not used: by the leg'
    alone = combine([leg(1, method('smoother', reasons=[fell]), reasons=rejected.reasons)], ALL)
    assert [r.text for r in alone.reasons if r.code is fell.code] == ['by the leg']
    fell = method('smoother', reasons=[REFUSED])
    one = leg(1, fell, method('two_point'),
              reasons=choice.rejected_method_reasons(several(fell, method('two_point')), 'all'))
    combined = combine([one, leg(2, method('smoother'), method('two_point'))], ALL).reasons
    assert [r.code for r in combined if 'a loop' in r.text] == [Code.LEG_REJECTED]
    combined = combine([one], ALL)
    assert [r.code for r in combined.reasons if 'a loop' in r.text] == [Code.METHOD_REJECTED]
    assert combined.verdict is Verdict.CAUTION


def driven(number, scale=0.02, sigma=2e-6, yaw=0.01, yaw_sigma=1e-4, unit='m/pulse'):
    one = method('two_point')
    return leg(number, replace(one, estimates=one.estimates | {
        'scale_factor': Estimate(scale, sigma, unit),
        'yaw_mounting_angle': Estimate(yaw, yaw_sigma, 'rad'),
        'pitch_mounting_angle': Estimate(None, None, 'rad')},
        sources=(Source('fixes', np.diag([sigma, yaw_sigma])),)))


def inconsistencies(*legs):
    return [r.text for r in inconsistent_legs(list(enumerate(legs, 1)))]


def test_legs_of_one_vehicle_are_consistent():
    # worn and new tyres, a mounting with 4 deg of play: LEGS_DISAGREE reports it, sigma increases
    assert inconsistencies(driven(1), driven(2, scale=0.0206, yaw=0.01 + 4 * DEG)) == []
    assert inconsistencies(driven(1)) == inconsistencies() == []
    assert inconsistencies(driven(1, yaw=179.9 * DEG), driven(2, yaw=-179.9 * DEG)) == []


@pytest.mark.parametrize(('legs', 'text'), [
    (({'scale': 0.0203}, {}, {'scale': 0.022}),
     'the scale of leg 3 is 10.0 % above that of leg 2 (limit 5 %): larger than'),
    (({}, {'yaw': 0.01 - 6 * DEG}),
     'the yaw mounting of leg 1 is 6.0 deg above that of leg 2 (limit 5 deg)'),
    (({}, {'scale': 0.03, 'yaw': 0.5}), ' and the yaw mounting of leg 2 is '),
    (({}, {'scale': 1.02, 'sigma': 1e-4, 'unit': '1'}, {}),
     'so their scales cannot be combined: m/pulse in leg 1, 3; 1 in leg 2'),
    # an IMU that points backwards
    (({'yaw': 177 * DEG}, {'yaw': -177 * DEG}),
     'the yaw mounting of leg 2 is 6.0 deg above that of leg 1')])
def test_legs_of_two_vehicles_are_named_by_scale_mounting_and_unit(legs, text):
    found, = inconsistencies(*(driven(k, **leg) for k, leg in enumerate(legs, 1)))
    assert text in found


@pytest.mark.parametrize('more', [
    {'scale': 0.03, 'sigma': 0.0021}, {'yaw': 0.5, 'yaw_sigma': 0.1}, {'yaw': None}])
def test_difference_within_the_sigmas_is_not_another_vehicle(more):
    assert inconsistencies(driven(1), driven(2, **more)) == []


def test_combination_is_rejected_or_its_sigma_is_compared_with_the_limit():
    whole = combine([driven(1), driven(2, scale=0.03)], Config())
    assert whole.verdict is Verdict.REJECTED
    assert [r.code for r in whole.reasons if r.code.severity is Verdict.REJECTED] == [
        Code.LEGS_UNLIKE]
    # 3 % apart: one vehicle, but the mean is not accurate to 0.1 %
    whole = combine([driven(1), driven(2, scale=0.0206)], Config())
    assert {Code.LEGS_DISAGREE, Code.SCALE_SIGMA_TOO_LARGE} <= {r.code for r in whole.reasons}
    assert whole.verdict is Verdict.CAUTION
