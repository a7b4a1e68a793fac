# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The method wheels as a member of the pipeline: what comes out of a leg with two counters."""

from dataclasses import replace

import drives
from drives import drive, everything_said
import numpy as np
import pytest

from odocal_ros.output.summary import screen as screen_text
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.pipeline.methods import found_by, METHODS, run_methods
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.screen import screen
from odocal_ros.sim.sensors import wheel_scales

ROUTE = {'scenario': 'town', 'duration': 300.0, 'two_wheels': True, 'imu_grade': 'industrial'}
SIGMAS = 4.0     # 1 in 16 000 of a normal error; seeds are fixed
WHEELS = ('scale_factor', 'scale_factor_left', 'scale_factor_right')


def settings(made, **changes):
    return drives.settings(made, **{'method': 'wheels'} | changes)


@pytest.fixture(scope='module')
def made():
    return drive(**ROUTE, seed=7)


@pytest.fixture(scope='module')
def result(made):
    return calibrate(made.leg(), settings(made))


def off(estimate, truth):
    """Return an error in sigmas."""
    return abs(estimate.value - truth) / estimate.sigma


def test_both_factors_the_angle_and_the_width_come_out(made, result):
    found = result.methods['wheels'].estimates
    truth = dict(zip(WHEELS, (made.options.scale, *wheel_scales(made.options)), strict=True))
    for name, true in truth.items():
        assert off(found[name], true) < SIGMAS
        # the leg tells each wheel better than the two differ by: 4 permille
        assert found[name].sigma < 1e-3 * true
    assert off(found['yaw_mounting_angle'], made.truth.yaw) < SIGMAS
    assert off(found['track_width'], made.options.track_width) < SIGMAS
    assert off(found['heading_error'], -made.truth.yaw) < SIGMAS   # its heading given: truth


def test_the_result_is_that_of_the_wheels_and_names_it(made, result):
    whole = combine([result], settings(made))
    assert {whole.estimates[name].method for name in WHEELS} == {'wheels'}
    assert 'pitch_mounting_angle' not in whole.estimates                   # wheels give none
    assert set(whole.methods) == {'two_point', 'wheels'}


def test_two_point_may_be_asked_for_and_is_then_the_only_one(made):
    config = settings(made, method='two_point')
    leg = calibrate(made.leg(), config)
    assert set(leg.methods) == {'two_point'}
    assert combine([leg], config).estimates['scale_factor'].method == 'two_point'


def test_wheels_asked_of_one_counter_are_refused_and_two_point_is_shown(made):
    one = drive(**ROUTE | {'two_wheels': False}, seed=7)
    config = settings(one, method='wheels')
    leg = calibrate(one.leg(), config)
    assert leg.verdict is Verdict.REJECTED
    assert 'odometer.left' in everything_said(leg)[Code.NO_METHOD]
    assert leg.methods['two_point'].estimates['scale_factor'].value is not None
    whole = combine([leg], config)
    assert whole.verdict is Verdict.REJECTED
    assert whole.estimates['scale_factor'].value is None


def test_corrected_factors_bring_the_track_to_the_fixes(made, result):
    """Before: 6 % of scale and a degree off; after: what white fixes of 1.5 m leave."""
    assert result.before.rms > 20.0
    assert result.after.rms < 2 * np.sqrt(2) * made.options.fix_sigma
    assert result.after.mean < result.after.rms < result.after.max


def test_a_gyro_that_turns_too_far_bends_no_corrected_track():
    # 1 % of 360 deg is 3.6 deg: tens of metres
    made = drive(**ROUTE | {'imu_grade': 'consumer'}, seed=7, gyro_scale_error=0.01)
    result = calibrate(made.leg(), settings(made))
    assert result.after.rms < 2 * np.sqrt(2) * made.options.fix_sigma


def test_a_fifth_held_back_is_not_in_the_fit_and_is_met_too(made):
    held = calibrate(made.leg(), settings(made), holdout=True)
    whole = calibrate(made.leg(), settings(made))
    a, b = (r.methods['wheels'].estimates['scale_factor_left'] for r in (held, whole))
    assert a.value != b.value
    assert a.sigma > b.sigma
    assert held.after.rms < held.before.rms / 5
    # nothing after the fifth's begin reaches the fit
    late = made.fix.stamp_ns > made.truth.start_ns + 0.9 * (
        made.truth.stop_ns - made.truth.start_ns)
    latitude = made.fix.latitude + late * 2e-5      # 127 m north
    again = calibrate(replace(made.leg(), fix=replace(made.fix, latitude=latitude)),
                      settings(made), holdout=True)
    # sums by BLAS differ in the last bit with where arrays lie in memory
    assert again.methods['wheels'].estimates['scale_factor_left'].value == pytest.approx(
        a.value, rel=1e-12)


def test_what_the_search_found_is_in_the_details_where_it_is_asked_for(made, result):
    assert 'search' not in result.methods['wheels'].details
    asked = calibrate(made.leg(), settings(made, method='patent'))
    assert set(asked.methods) == {'two_point', 'wheels'}
    # it stands beside the values and moves none of them
    assert asked.methods['wheels'].estimates == result.methods['wheels'].estimates
    search = asked.methods['wheels'].details['search']
    assert search['array']['name'].startswith('L49')
    assert search['before']['rms'] > search['after']['rms']
    shown = screen_text(combine([asked], settings(made, method='patent')))
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
    assert found_by(onward, prepared) == found_by(backward, prepared)


def test_exchanged_wheels_reject_the_leg(made):
    leg = made.leg()
    swapped = calibrate(replace(leg, odometer=leg.odometer_right, odometer_right=leg.odometer),
                        settings(made))
    assert swapped.verdict is Verdict.REJECTED
    assert 'WHEELS_SWAPPED' in {c.name for c in everything_said(swapped)}


def test_a_slip_of_one_wheel_is_named_once_and_counts_half_in_the_mean(made):
    leg = made.leg()
    t = (leg.odometer.stamp_ns - leg.start_ns) * 1e-9
    spun = np.rint(np.clip((t - 100.0) / 2.0, 0.0, 1.0) * 0.5 / made.options.scale)
    slipped = replace(leg, odometer=replace(
        leg.odometer, value=leg.odometer.value + spun.astype(np.int64)))
    result = calibrate(slipped, settings(made))
    assert sum(r.code is Code.WHEEL_SLIP for r in result.reasons) == 1
    source = next(s for s in result.methods['two_point'].sources if s.name == 'wheel_slip')
    whole = next(s for s in result.methods['wheels'].sources if s.name == 'wheel_slip')
    assert source.effects[0] @ source.effects[0] > 0
    assert whole.effects[0] @ whole.effects[0] > 0


def test_a_track_width_given_wrong_is_said(made):
    given = 1.1 * made.options.track_width
    leg = calibrate(made.leg(), settings(made, odometer__track_width=given))
    text = everything_said(leg)[Code.TRACK_WIDTH_FAR_FROM_GIVEN]
    assert f'odometer.track_width says {given:.4g} m' in text
    near = calibrate(made.leg(), settings(made, odometer__track_width=made.options.track_width))
    assert Code.TRACK_WIDTH_FAR_FROM_GIVEN not in everything_said(near)


def test_legs_of_two_wheels_combine(made, result):
    other = drive(**ROUTE, seed=8, start_ns=made.options.start_ns + 10**13)
    legs = [result, calibrate(other.leg(), settings(other))]
    whole = combine(legs, settings(made))
    for name in WHEELS:
        alone = [leg.methods['wheels'].estimates[name] for leg in legs]
        assert min(e.value for e in alone) <= whole.estimates[name].value \
            <= max(e.value for e in alone)
        assert whole.estimates[name].sigma < max(e.sigma for e in alone)
    assert whole.estimates['heading_error'].value is None      # each leg's own at its start
