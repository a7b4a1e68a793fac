# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two wheels in the pipeline: results of a leg with two counters."""

import drives
from drives import drive
import numpy as np
import pytest

from odocal_ros.output.summary import screen as screen_text
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.pipeline.methods import METHODS, reasons_on_data, run_methods
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow
ROUTE = {'scenario': 'town', 'duration': 300.0, 'two_wheels': True, 'imu_grade': 'industrial'}
MADE = ROUTE | {'seed': 7}
SIGMAS = 4.0     # 1 in 16 000 of a normal error; seeds are fixed
WHEELS = ('scale_factor', 'scale_factor_left', 'scale_factor_right')


def settings(made, **changes):
    return drives.settings(made, **{'method': 'smoother'} | changes)


@pytest.fixture(scope='module')
def result(made):
    return calibrate(made.leg(), settings(made))


def test_the_mean_of_both_wheels_is_the_scale_factor(result):
    scale, left, right = (result.methods['smoother'].estimates[name] for name in WHEELS)
    # left and right are computed apart, each to a thousandth of its sigma of 2 ppm
    assert 2 / (1 / left.value + 1 / right.value) == pytest.approx(scale.value, rel=1e-8)
    of_scale, *of_wheels = (e.sigma / e.value for e in (scale, left, right))
    assert of_scale <= min(of_wheels) <= max(of_wheels) < 1.1 * of_scale


def test_result_is_from_the_smoother_and_its_track_agrees_with_the_fixes(made, result):
    whole = combine([result], settings(made))
    assert {whole.estimates[name].method for name in WHEELS} == {'smoother'}
    assert set(whole.methods) == {'two_point', 'smoother'}
    assert result.before.rms > 20.0
    assert result.after.rms < 2 * np.sqrt(2) * made.options.fix_sigma
    assert result.after.mean < result.after.rms < result.after.max


def test_methods_wheels_and_two_point_select_the_smoother_and_the_end_points(made, result):
    again = calibrate(made.leg(), settings(made, method='wheels'))
    assert again.methods['smoother'].estimates == result.methods['smoother'].estimates
    whole = combine([again], settings(made, method='wheels'))
    assert whole.estimates['scale_factor_left'].method == 'smoother'
    config = settings(made, method='two_point')
    leg = calibrate(made.leg(), config)
    assert set(leg.methods) == {'two_point'}
    assert combine([leg], config).estimates['scale_factor'].method == 'two_point'


def test_one_counter_gives_no_values_of_two_wheels():
    one = drive(**ROUTE | {'two_wheels': False}, seed=7)
    leg = calibrate(one.leg(), settings(one))
    assert leg.methods['smoother'].estimates['scale_factor'].value is not None
    assert not set(WHEELS[1:]) & set(leg.methods['smoother'].estimates)
    assert 'wheels' not in leg.methods['smoother'].details


def test_a_rejected_leg_lists_both_wheels_as_unknown(made):
    leg = made.leg()
    inside = np.flatnonzero(leg.fix.stamp_ns > leg.start_ns)
    few = drives.kept(leg, 'fix', inside[::200])        # one in 40 s: 7 of the required 10
    found = calibrate(few, settings(made)).methods['smoother'].estimates
    assert all(found[name].value is None for name in (*WHEELS, 'track_width'))


def test_a_gyro_scale_error_does_not_bend_the_corrected_track():
    # 1 % of 360 deg is 3.6 deg: tens of metres
    made = drive(**ROUTE | {'imu_grade': 'consumer'}, seed=7, gyro_scale_error=0.01)
    result = calibrate(made.leg(), settings(made))
    assert result.after.rms < 2 * np.sqrt(2) * made.options.fix_sigma


def test_the_holdout_is_not_in_the_fit_and_agrees_with_the_track(made, result):
    held = calibrate(made.leg(), settings(made), holdout=True)
    a, b = (r.methods['smoother'].estimates['scale_factor_left'] for r in (held, result))
    assert a.value != b.value
    assert a.sigma > b.sigma
    assert held.after.rms < held.before.rms / 5
    # nothing after the start of the holdout is in the fit
    late = made.fix.stamp_ns > made.truth.start_ns + 0.9 * (
        made.truth.stop_ns - made.truth.start_ns)
    # 127 m north
    moved = drives.with_columns(made.leg(), 'fix', latitude=lambda x: x + late * 2e-5)
    again = calibrate(moved, settings(made), holdout=True)
    # sums by BLAS differ in the last bit with where arrays lie in memory
    assert again.methods['smoother'].estimates['scale_factor_left'].value == pytest.approx(
        a.value, rel=1e-12)


def test_details_contain_the_result_of_the_search_if_configured(made, result):
    assert 'search' not in result.methods['smoother'].details
    patent_result = calibrate(made.leg(), settings(made, method='patent'))
    assert set(patent_result.methods) == {'two_point', 'smoother'}
    # it changes no value
    assert patent_result.methods['smoother'].estimates == result.methods['smoother'].estimates
    search = patent_result.methods['smoother'].details['search']
    assert search['array']['name'].startswith('L49')
    assert search['before']['rms'] > search['after']['rms']
    shown = screen_text(combine([patent_result], settings(made, method='patent')))
    assert f'response surface{search["response_surface"]["scale_left"]:20.6g}' in shown
    assert 'CN104359492A' not in screen_text(combine([result], settings(made)))
    surface, direct = search['response_surface'], search['least_squares']
    assert surface['scale_left'] == pytest.approx(direct['scale_left'], rel=1e-4 * 0.1)


def test_the_order_of_the_methods_does_not_matter(made):
    leg, config = made.leg(), settings(made, method='all')
    inputs, _ = screen(leg, config)
    prepared, _ = prepare(leg, inputs, config)
    onward, backward = (run_methods(names, prepared, lambda name: lambda passes: None)
                        for names in (list(METHODS), list(METHODS)[::-1]))
    assert list(onward) == list(backward)[::-1]
    for name, run in onward.items():
        assert run.result.estimates == backward[name].result.estimates
        assert run.result.reasons == backward[name].result.reasons
    assert reasons_on_data(onward, prepared) == reasons_on_data(backward, prepared)


def test_slip_of_one_wheel_is_reported_once_and_changes_no_ratio_or_mean(made, result):
    leg = made.leg()
    t = drives.seconds(leg, leg.odometer)
    spun = np.rint(np.clip((t - 100.0) / 2.0, 0.0, 1.0) * 0.5 / made.options.scale)
    slipped = drives.with_columns(leg, 'odometer', value=lambda n: n + spun.astype(np.int64))
    clean, result = result, calibrate(slipped, settings(made))
    assert sum(r.code is Code.WHEEL_SLIP for r in result.reasons) == 1
    source = next(s for s in result.methods['two_point'].sources if s.name == 'wheel_slip')
    assert source.effects[0] @ source.effects[0] > 0
    before, after = (x.methods['smoother'] for x in (clean, result))
    # half a metre of 1300 m is 380 ppm of the left wheel, 190 ppm of the mean: the sigma is
    # 170 ppm from the fixes, and some ppm for the ratio
    scale = after.estimates['scale_factor']
    assert abs(scale.value - before.estimates['scale_factor'].value) < 0.5 * scale.sigma
    ratio, was = (x.details['wheels']['left']['ratio'] for x in (after, before))
    assert abs(ratio - was) < 4 * after.details['wheels']['left']['ratio_sigma'] < 4e-5


def test_legs_of_two_wheels_combine(made, result):
    other = drive(**ROUTE, seed=8, start_ns=made.options.start_ns + 10**13)
    legs = [result, calibrate(other.leg(), settings(other))]
    whole = combine(legs, settings(made))
    for name in WHEELS:
        alone = [leg.methods['smoother'].estimates[name] for leg in legs]
        assert whole.estimates[name].sigma < min(e.sigma for e in alone)
    assert drives.off(whole, made, *WHEELS) < SIGMAS
    alone = [leg.methods['smoother'].estimates['track_width'].value for leg in legs]
    assert min(alone) <= whole.estimates['track_width'].value <= max(alone)
    scale, left, right = (whole.estimates[name].value for name in WHEELS)
    # ratios of legs are averaged: two wheels' factors err by the square of what they differ by
    assert 2 / (1 / left + 1 / right) == pytest.approx(scale, rel=1e-6)


def test_a_leg_of_one_counter_combines_with_one_of_two(made, result):
    one = drive(**ROUTE | {'two_wheels': False}, seed=8, start_ns=made.options.start_ns + 10**13)
    alone = calibrate(one.leg(), settings(one))
    for legs in ([result, alone], [alone, result]):
        whole = combine(legs, settings(made))
        scale, left, right = (whole.estimates[name].value for name in WHEELS)
        assert 2 / (1 / left + 1 / right) == pytest.approx(scale, rel=1e-6)
