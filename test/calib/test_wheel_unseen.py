# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A slip that the gyro takes for part of a turn: found by the whole fit, named, in the sigmas."""

from dataclasses import replace
from functools import cache

from drives import drive, seconds, settings
import numpy as np
import pytest
from wheel_legs import wheel_leg

from odocal_ros.calib.wheels.estimate import solve
from odocal_ros.calib.wheels.result import fit_wheels
from odocal_ros.calib.wheels.unseen import drawn_out, unseen_slip
from odocal_ros.calib.wheels.wheel_slips import NO_SLIPS, with_unseen
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code

SIZE = 0.23          # m
ROUTE = {'scenario': 'town', 'duration': 240.0, 'two_wheels': True, 'imu_grade': 'tactical'}


@cache
def made(seed=16, fix_noise='white'):
    return drive(**ROUTE, seed=seed, fix_noise=fix_noise)


def turn_begins(one):
    """Return when the first turn of a drive begins, s."""
    leg = one.leg()
    apart = np.diff(leg.odometer.value - leg.odometer_right.value)
    turning = np.abs(np.convolve(apart, np.ones(20), 'same')) > 5
    return float(seconds(leg, leg.odometer)[1:][turning][0])


def slipped(one, side, size=SIZE):
    """Return the drive's leg, a wheel running farther within five seconds of the first turn."""
    leg, name = one.leg(), 'odometer_right' if side else 'odometer'
    wheel = getattr(leg, name)
    way = np.clip((seconds(leg, wheel) - turn_begins(one)) / 5.0, 0, 1) * size
    return replace(leg, **{name: replace(wheel, value=wheel.value + np.floor(
        way / one.options.scale).astype(np.int64))})


@pytest.mark.parametrize('side', [0, 1])
@pytest.mark.parametrize('size', [SIZE, -1.0])
def test_the_step_that_stands_out_has_place_size_and_sign(side, size):
    one = made()
    found = unseen_slip(solve(wheel_leg(slipped(one, side, size), settings(one)), settings(one)))
    (begin, end), seen, sigma, wheel = found
    middle = turn_begins(one) + 2.5
    assert abs((begin + end) / 2 - middle) < 5.0          # a bin is 2.4 s, the slip 5 s
    assert end - begin < 10.0
    if wheel < 0:       # fixes of 1.5 m do not tell which wheel: a slip of the other is as good
        seen = abs(seen) * np.sign(size)
    # a step is no ramp: 2.5 s of either end
    assert abs(seen - size) < 4 * sigma + 0.25 * abs(size)


@pytest.mark.parametrize('side', [0, 1])
def test_it_is_said_and_held(side):
    one = made()
    config = settings(one)
    method = fit_wheels(wheel_leg(slipped(one, side), config), config)
    (reason,) = (r for r in method.reasons if r.code is Code.WHEEL_SLIP)
    assert 'the sigmas hold it' in reason.text
    e = method.estimates
    assert abs(e['track_width'].value - one.options.track_width) < 3 * e['track_width'].sigma
    for name, true in zip(('scale_factor_left', 'scale_factor_right'), one.truth.wheel_scales,
                          strict=True):
        assert abs(e[name].value - true) < 3 * e[name].sigma


def test_rtk_fixes_name_the_wheel():
    one = made(fix_noise='rtk')
    for side in (0, 1):
        leg = wheel_leg(slipped(one, side, 0.6), settings(one))
        assert unseen_slip(solve(leg, settings(one)))[-1] == side


def test_nothing_stands_out_of_clean_drives_nor_near_known_slips():
    for seed in range(4):
        one = made(seed, ('white', 'rtk')[seed % 2])
        assert unseen_slip(solve(wheel_leg(one.leg(), settings(one)), settings(one))) is None
    one = made()
    solution = solve(wheel_leg(slipped(one, 1), settings(one)), settings(one))
    found = unseen_slip(solution, [turn_begins(one)])
    assert found is None or abs(found[0][0] - turn_begins(one)) > 30.0


def test_wheels_that_are_known_to_fail_are_not_searched():
    one = made()
    leg = replace(wheel_leg(slipped(one, 1), settings(one)), uneven=True)
    assert Code.WHEEL_SLIP not in {r.code for r in fit_wheels(leg, settings(one)).reasons}


def test_steps_of_a_slip_have_its_size_together_and_lie_about_it():
    t, size = drawn_out([10.0, 50.0], [14.0, 50.3], [1.7, -0.4])
    first = t < 40.0
    assert (size[first]**2).sum() == pytest.approx(1.7**2)
    assert (size[~first]**2).sum() == pytest.approx(0.4**2)
    assert t[first].min() < 10.0
    assert t[first].max() > 14.0
    assert np.diff(t[first]).max() <= 1.0
    assert [len(x) for x in drawn_out([], [], [])] == [0, 0]


def test_a_slip_of_seconds_seen_by_the_gyro_is_held_with_fixes_of_centimetres():
    """As one step in its middle the ramp is 0.4 m off the fixes: 20 of their sigmas."""
    for seed in range(3):
        one = drive(**ROUTE | {'imu_grade': 'consumer'}, seed=seed, fix_noise='rtk')
        leg, begin = slipped(one, 1, -1.7), turn_begins(one)
        leg = replace(wheel_leg(leg, settings(one)),
                      slips=drawn_out([begin], [begin + 5.0], [1.7]))
        e = fit_wheels(leg, settings(one)).estimates
        for name, true in zip(('scale_factor', 'scale_factor_left', 'scale_factor_right'),
                              (one.truth.scale, *one.truth.wheel_scales), strict=True):
            assert abs(e[name].value - true) < 4 * e[name].sigma


def test_slips_of_both_kinds_come_in_order_of_time():
    seen = [{'t': 30.0, 'duration': 4.0, 'metres': -0.5, 'wheel': 'right'},
            {'t': 9.0, 'duration': 1.0, 'metres': 0.2, 'wheel': 'one of them'}]
    slips = with_unseen(with_unseen(NO_SLIPS, seen[:1]), seen[1:])
    assert slips.begin.tolist() == [9.0, 30.0]
    assert slips.end.tolist() == [10.0, 34.0]
    assert slips.size.tolist() == [0.2, -0.5]
    assert slips.wheel.tolist() == [0, 1]


def test_a_slow_slide_in_town_is_in_the_sigma_of_the_smoother_too():
    one = drive(**ROUTE | {'imu_grade': 'industrial', 'duration': 283.0}, seed=413)
    leg = one.leg()
    wheel = leg.odometer
    way = np.clip((seconds(leg, wheel) - 78.2) / 46.8, 0, 1) * -2.74
    leg = replace(leg, odometer=replace(wheel, value=wheel.value + np.floor(
        way / one.options.scale).astype(np.int64)))
    result = calibrate(leg, settings(one, method='auto', odometer__track_width=1.6))
    (slip,) = result.methods['wheels'].details['slips']
    assert slip['wheel'] == 'left'
    assert abs(slip['t'] + slip['duration'] / 2 - 101.5) < 10.0
    for method in ('wheels', 'smoother'):
        e = result.methods[method].estimates['scale_factor']
        # what a slide of 2.7 m of one wheel makes of the mean, known to its size
        assert abs(e.value - one.truth.scale) < 2 * e.sigma
