# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Vehicles with more than two wheels in one message: screening, mean, factors and places."""

from dataclasses import replace
from functools import cache

from drives import changed, drive, settings
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.calib.slip import join_axles, WheelSlips
from odocal_ros.data.inputs import WHEELS
from odocal_ros.estimator.result.wheel_result import Wheel, wheel_estimates
from odocal_ros.output.summary import screen as printed
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.axles import pair_wheels, steering_path
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config
from odocal_ros.sim.wheels import wheels_of

pytestmark = pytest.mark.slow
ROUTE = {'scenario': 'town', 'duration': 200.0, 'imu_grade': 'industrial', 'seed': 3}
FOUR = ['front_left', 'front_right', 'rear_left', 'rear_right']
SIGMAS = 4.0        # 1 in 16 000 of a normal error; seeds are fixed


@cache
def made(**options):
    return drive(**ROUTE | {'wheels': 4} | options)


def config(one, **changes):
    return settings(one, odometer__wheels=one.joints, **changes)


@cache
def result_of(**options):
    one = made(**options)
    return calibrate(one.leg(), config(one, method='smoother'))


def calibrated(**options):
    return made(**options), result_of(**options).methods['smoother']


def codes(reasons):
    return {reason.code: reason.text for reason in reasons}


def with_dead(one, dead):
    return one.leg().with_rows(**{WHEELS[k]: changed(one.wheels[k], value=lambda a: 0 * a)
                                  for k in dead})


@pytest.mark.parametrize('options', [
    {}, {'front_steers': False}, {'wheels': 3}, {'wheels': 6}, {'imu_grade': 'consumer'},
    {'wheelbase': 1.0, 'track_width': 0.6}], ids=str)
def test_factors_and_places_are_within_their_sigmas(options):
    one, method = calibrated(**options)
    found, wheels = method.estimates, wheels_of(one.options)
    assert abs(found['scale_factor'].value - one.truth.scale) < SIGMAS * found[
        'scale_factor'].sigma
    # the places are those from the mean of the counts that do not steer
    fixed = [wheel for wheel in wheels if not wheel.steered]
    middle = np.average([w.arm[1] for w in fixed], weights=[1 / w.scale for w in fixed])
    for wheel in wheels:
        e, beside = found[f'scale_factor_{wheel.name}'], method.details['wheels'][wheel.name]
        assert abs(e.value - wheel.scale) < SIGMAS * e.sigma
        # without the common error of the scale factor; 1 ppm as for two wheels
        assert abs(beside['ratio'] * one.truth.scale / wheel.scale - 1) < SIGMAS * np.hypot(
            beside['ratio_sigma'], 1e-6)
        # 0.1 mm: of a single wheel between left and right y_sigma is some micrometres
        assert abs(beside['y'] - (wheel.arm[1] - middle)) < SIGMAS * np.hypot(
            beside['y_sigma'], 1e-4)
        assert ('x' in beside) is wheel.steered
        if wheel.steered:
            assert abs(beside['x'] - one.options.wheelbase) < SIGMAS * beside['x_sigma']
            assert beside['x_sigma'] < 0.02 * beside['x']


def test_the_mean_is_that_of_the_wheels_that_do_not_steer():
    one = made()
    inputs, found = screen(one.leg(), config(one))
    rear = [wheel.s for wheel in inputs.travels[2:]]
    np.testing.assert_allclose(inputs.travel.s, (rear[0] + rear[1]) / 2, atol=1e-9)
    assert codes(found)[Code.WHEELS_STEERED] == (
        'front_left and front_right are steered: a steered wheel travels farther in turns. '
        'The scale factor is '
        'that of the mean of rear_left and rear_right')
    fixed = made(front_steers=False)
    inputs, found = screen(fixed.leg(), config(fixed))
    np.testing.assert_allclose(inputs.travel.s, np.mean([w.s for w in inputs.travels], axis=0),
                               atol=1e-9)
    assert not found


def test_the_distance_ahead_follows_from_the_turns():
    one = made()
    inputs, _ = screen(one.leg(), config(one))
    front = [wheel.distance_ahead * one.truth.scale for wheel in inputs.travels]
    assert front == pytest.approx([2.7, 2.7, 0.0, 0.0], rel=0.02)


def test_a_steered_wheel_on_a_circle_rolls_about_the_centre():
    """On a radius R of the rear axle a wheel (x, y) has a radius of hypot(R - y, x)."""
    R, x, y, speed = 8.0, 2.7, 0.8, 5.0
    t = np.arange(0.0, 60.0, 0.1)
    s, turn = speed * t, speed * t / R
    more = x**2 * steering_path(t, turn, s, x, y)
    np.testing.assert_allclose(more, (np.hypot(R - y, x) - (R - y)) / R * s, rtol=1e-9, atol=1e-9)
    small = steering_path(t, turn, s)
    np.testing.assert_allclose(small, s / R**2 / 2, rtol=1e-9, atol=1e-9)
    back = steering_path(t, -turn, -s, x, y)
    np.testing.assert_allclose(back, -steering_path(t, turn, s, x, y), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(('steers', 'dead'), [
    (True, (1,)), (False, (0,)), (False, (3,))], ids=str)
def test_an_axle_with_a_dead_wheel_is_left_out_with_a_caution(steers, dead):
    one = made(front_steers=steers)
    result = calibrate(with_dead(one, dead), config(one, method='smoother'))
    said = codes(result.reasons)
    assert Code.WHEEL_DEAD not in said
    assert FOUR[dead[0]] in said[Code.WHEEL_LEFT_OUT]
    assert Code.WHEEL_LEFT_OUT.severity is Verdict.CAUTION
    method = result.methods['smoother']
    left = FOUR[2:] if dead[0] < 2 else FOUR[:2]
    assert list(method.details['wheels']) == left
    scale = method.estimates['scale_factor']
    true = 2 / sum(1 / wheel.scale for wheel in wheels_of(one.options) if wheel.name in left)
    assert abs(scale.value - true) < SIGMAS * scale.sigma


@pytest.mark.parametrize('dead', [(2,), (2, 3), (0, 1), (0, 3)], ids=str)
def test_without_an_axle_that_is_known_not_to_steer_the_leg_is_rejected(dead):
    """No wheel of the rear axle counts, or both front wheels: the steered axle is unknown."""
    one = made()
    _, found = screen(with_dead(one, dead), config(one))
    assert Code.WHEEL_DEAD in codes(found)
    assert Code.WHEEL_LEFT_OUT not in codes(found)


def test_a_single_dead_wheel_and_a_reversed_wheel_of_each_axle_are_found():
    one = made(wheels=3)
    _, found = screen(with_dead(one, (2,)), config(one))
    assert codes(found)[Code.WHEEL_DEAD].startswith(
        'front did not count: the travel is 0 % of that of the wheel that travels most')
    one = made()
    leg = one.leg().with_rows(**{WHEELS[k]: changed(one.wheels[k], value=lambda a: -a)
                                 for k in (0, 2)})
    inputs, found = screen(leg, config(one))
    assert [reason.code for reason in found].count(Code.WHEEL_REVERSED) == 2
    assert len(inputs.travels) == 4


def test_slip_of_one_of_four_wheels_is_reported_and_factors_are_correct():
    one = made(front_steers=False, odometer_rate=50.0)
    t = (one.wheels[1].stamp_ns - one.truth.start_ns) * 1e-9
    spun = np.clip((t - 100.0) / 1.0, 0.0, 1.0) * 1.0 / one.truth.scale       # 1 m
    leg = replace(one.leg(), odometer_right=changed(one.wheels[1], value=lambda a: a + spun))
    result = calibrate(leg, config(one, method='smoother'))
    assert 'the front_right wheel spins: 1' in codes(result.reasons)[Code.WHEEL_SLIP]
    method = result.methods['smoother']
    for wheel in wheels_of(one.options):
        e = method.estimates[f'scale_factor_{wheel.name}']
        assert abs(e.value - wheel.scale) < SIGMAS * e.sigma


def test_the_share_of_a_slip_in_the_mean_is_one_over_the_wheels():
    first, second = (WheelSlips(np.array([t]), np.array([t + 2.0]), np.array([size]),
                                np.array([1])) for t, size in ((50.0, 0.4), (10.0, 0.8)))
    both = join_axles((first, second), 4)
    assert both.begin.tolist() == [10.0, 50.0]
    t, sigma = both.uncertain_travel()
    for begin, size in ((10.0, 0.8), (50.0, 0.4)):
        inside = (t > begin) & (t < begin + 2.0)
        assert np.linalg.norm(sigma[inside]) == pytest.approx(size / 4)


def departing(**ratios):
    wheels = {name: Wheel(ratio, 1e-4, side * 0.8, 1e-3, (1e-3,))
              for (name, ratio), side in zip(ratios.items(), (1, -1) * 2, strict=True)}
    _, reasons = wheel_estimates(list(wheels), wheels, Estimate(0.3, 3e-5, 'm/rad'), Config())
    return codes(reasons).get(Code.WHEEL_DEPARTS, '')


def test_the_wheel_that_deviates_is_reported():
    text = departing(fl=1.0, fr=0.98, rl=1.002, rr=1.001)
    assert text.startswith('the factor of wheel fr is 2.10 % smaller than that of the others '
                           '(limit 1 %). Likely cause: ')
    assert departing(fl=1.0, fr=0.995, rl=1.002, rr=1.001) == ''
    # two axles with different wheels: none deviates
    assert departing(fl=1.03, fr=1.031, rl=1.0, rr=1.001) == ''


def test_each_axle_is_a_pair_of_wheels_with_its_track_width():
    assert pair_wheels(('a', 'b', 'c', 'd', 'e')) == [('a', 'b'), ('c', 'd'), ('e',)]
    one, method = calibrated()
    widths = [name for name in method.estimates if name.startswith('track_width')]
    assert widths == ['track_width_front_left_front_right', 'track_width_rear_left_rear_right']
    for name in widths:
        e = method.estimates[name]
        assert abs(e.value - one.options.track_width) < SIGMAS * e.sigma
        assert e.sigma < 0.03 * e.value


def test_the_summary_has_a_line_for_each_wheel():
    one = made()
    its = config(one, method='smoother')
    text = printed(combine([result_of()], its))
    for name in FOUR:
        (line,) = [line for line in text.splitlines() if line.startswith(f'  wheel {name} ')]
        assert (' m left' if name.endswith('left') else ' m right') in line
        assert (' m ahead' in line) == name.startswith('front')
