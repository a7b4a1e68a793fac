# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Both wheels separately: ratio and track width on simulated drives, and refusals."""

from dataclasses import replace

from drives import cached, changed, drive, off, settings
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.data.samples import take
from odocal_ros.estimator.result import wheel_result
from odocal_ros.estimator.result.wheel_result import Wheel
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, SIDES, with_settings
from odocal_ros.settings.nominal import GRADES

pytestmark = pytest.mark.slow
TOWN = {'scenario': 'town', 'duration': 300.0, 'two_wheels': True, 'imu_grade': 'industrial'}
SCALES = ('scale_factor', 'scale_factor_left', 'scale_factor_right')
SIGMAS = 4.0        # 1 in 16 000 of a normal error; seeds are fixed
SCALE = Estimate(0.02, 2e-6, 'm/pulse')


@cached
def result_of(given=0.0, **options):
    made = drive(**TOWN | options)
    return made, smoothed(made, odometer__track_width=given)


def smoothed(made, leg=None, **more):
    config = settings(made, method='smoother', **more)
    return calibrate(leg or made.leg(), config).methods['smoother']


def ratio_off(made, method):
    """Return the relative error of right over left, and its sigma."""
    left, right = (method.details['wheels'][side] for side in ('left', 'right'))
    true = made.truth.wheel_scales[1] / made.truth.wheel_scales[0]
    return right['ratio'] / left['ratio'] / true - 1, 2 * left['ratio_sigma']


def codes(method):
    return {r.code for r in method.reasons}


@pytest.mark.parametrize('options', [
    {'seed': 1}, {'seed': 3, 'imu_grade': 'consumer'},
    {'seed': 4, 'fix_noise': 'rtk'},
    {'seed': 5, 'odometer': 'angle'}, {'seed': 7, 'slip_walk': 0.01},
    {'seed': 8, 'wheel_difference': -0.5}, {'seed': 9, 'scenario': 'out_and_back'}],
    ids=str)
def test_factors_and_width_are_within_their_sigmas(options):
    made, method = result_of(**options)
    found = method.estimates
    assert off(found, made, *SCALES, 'track_width') < SIGMAS
    # 1 ppm of the ratio: attitude errors between the ends, 1 mrad by 0.8 m in 1300 m
    error, sigma = ratio_off(made, method)
    assert abs(error) < SIGMAS * np.hypot(sigma, 1e-6)
    assert found['track_width'].sigma < 0.03 * found['track_width'].value
    mean = 2 / (1 / found['scale_factor_left'].value + 1 / found['scale_factor_right'].value)
    assert mean == pytest.approx(found['scale_factor'].value, rel=1e-8)


def test_sigma_of_the_ratio_is_that_of_the_random_walk():
    """Wheels with slip of 10 mm/sqrt(s) each: right minus left has sqrt(2 T) 10 mm in the path."""
    made, method = result_of(seed=7, slip_walk=0.01)
    driven = 280.0 - 2 * 10.0       # s from the start mark, about: without stops
    expected = np.sqrt(2 * driven) * 0.01 / made.truth.distance
    _, sigma = ratio_off(made, method)
    # a level from 200 increments has an error of a tenth, the time driven of a fifth
    assert sigma == pytest.approx(expected, rel=0.4)


def test_wheels_with_different_counters_have_separate_factors():
    """Right counts twice as often: the mean of the counters is not that of both sides."""
    made, _ = result_of(seed=1)
    leg = made.leg()
    method = smoothed(made, replace(leg, odometer_right=changed(
        leg.odometer_right, value=lambda n: 2 * n)))
    left, right = made.truth.wheel_scales[0], made.truth.wheel_scales[1] / 2
    for name, true in (('scale_factor_left', left), ('scale_factor_right', right),
                       ('scale_factor', 2 / (1 / left + 1 / right))):
        e = method.estimates[name]
        assert abs(e.value - true) < SIGMAS * e.sigma
    assert off(method, made, 'track_width') < SIGMAS


def test_travel_in_a_gap_of_one_wheel_does_not_affect_the_ratio():
    made, _ = result_of(seed=1)
    leg = made.leg()
    t = (leg.odometer.stamp_ns - leg.start_ns) * 1e-9
    lost = np.where(t > 120.0, 40, 0)       # counts, 0.85 m: 650 ppm of the path
    kept = (t < 118.0) | (t > 122.0)
    odometer = take(changed(leg.odometer, value=lambda n: n - lost), kept)
    error, sigma = ratio_off(made, smoothed(made, replace(leg, odometer=odometer)))
    assert abs(error) < SIGMAS * np.hypot(sigma, 1e-6) < 5e-5


def test_straight_path_determines_the_ratio_and_not_the_track_width():
    made, method = result_of(scenario='straight', seed=3)
    assert method.estimates['track_width'].value is None
    assert Code.TRACK_WIDTH_NOT_DETERMINED in codes(method)
    error, sigma = ratio_off(made, method)
    assert abs(error) < SIGMAS * sigma < 4e-5
    assert method.estimates['scale_factor_left'].value is not None


def test_configured_width_counts_as_measured_by_tape():
    made, method = result_of(scenario='straight', seed=3, given=1.6)
    assert method.estimates['track_width'].value is None      # not more accurate than the tape
    assert not {Code.TRACK_WIDTH_NOT_DETERMINED, Code.TRACK_WIDTH_FAR_FROM_GIVEN} & codes(method)
    left, right = (method.details['wheels'][side] for side in ('left', 'right'))
    assert left['y'] - right['y'] == pytest.approx(1.6, abs=0.02 * 1.6)
    assert left['y_sigma'] + right['y_sigma'] == pytest.approx(0.02 * 1.6, rel=1e-3)
    error, sigma = ratio_off(made, method)
    assert abs(error) < SIGMAS * sigma


def test_width_is_no_better_than_the_turns_are_known():
    """With fixes of 30 m only the gyro measures turns: its scale error of 1 % is in the width."""
    made = drive(**TOWN | {'imu_grade': 'consumer', 'seed': 4, 'fix_sigma': 30.0,
                           'gyro_scale_error': 0.01})
    method = smoothed(made, gnss__max_sigma=100.0)
    assert off(method, made, 'track_width') < SIGMAS
    width = method.estimates['track_width']
    sold = GRADES['consumer'].gyro_scale_sigma
    # the drive gives some information: heading at the ends to some degrees of 360 and more
    assert 0.2 * sold < width.sigma / width.value < 1.2 * sold


# statement of wheel values

def pair(delta=2e-3, sigma=1e-6, width=1.6, width_sigma=1e-3):
    """Return two wheels with mirrored values, as the lines of one pair have."""
    return {name: Wheel(1 / (1 + side * delta), sigma, side * width / 2, width_sigma / 2, (1e-3,))
            for name, side in zip(SIDES, (1, -1), strict=True)}


def estimate(wheels, scale=SCALE, **changed_settings):
    config = with_settings(Config(), {k.replace('__', '.'): v
                                      for k, v in changed_settings.items()})
    return wheel_result.wheel_estimates(SIDES, wheels, scale, config)


def test_sigma_of_a_wheel_combines_scale_and_ratio():
    found, reasons = estimate(pair(sigma=2e-4))
    assert reasons == []
    left = found['scale_factor_left']
    assert left.value == pytest.approx(0.02 / 1.002)
    assert left.sigma / left.value == pytest.approx(np.hypot(1e-4, 2e-4))
    assert (found['track_width'].value, found['track_width'].sigma) == pytest.approx((1.6, 1e-3))


def test_undetermined_wheels_are_not_stated_but_reported():
    # the ratio has twice the relative error of a wheel: 2.5 % is half of 5 %
    near, _ = estimate(pair(sigma=0.0124))
    assert near['scale_factor_left'].value is not None
    for wheels, text in ((pair(sigma=0.0126), '2.5 %'), ({}, 'is not known')):
        found, (reason,) = estimate(wheels)
        assert found == wheel_result.unknown_wheels(SIDES, 'm/pulse')
        assert reason.code is Code.WHEELS_NOT_SEPARABLE
        assert text in reason.text
    # the method itself reports why there is no scale
    unknown = Estimate(None, None, '1')
    assert estimate(pair(), unknown) == (wheel_result.unknown_wheels(SIDES, '1'), [])


@pytest.mark.parametrize(('width', 'sigma', 'given', 'code'), [
    (1.6, 0.1, 0.0, Code.TRACK_WIDTH_NOT_DETERMINED),       # 5 % is the limit
    (0.05, 1e-3, 0.0, Code.TRACK_WIDTH_NOT_DETERMINED),     # at least 0.1 m
    (-1.6, 1e-3, 0.0, Code.TRACK_WIDTH_NOT_DETERMINED),
    (1.6, 0.017, 1.6, None)])                               # known from the tape to 0.032 m
def test_undetermined_width_is_not_stated(width, sigma, given, code):
    found, reasons = estimate(pair(width=width, width_sigma=sigma), odometer__track_width=given)
    assert found['track_width'].value is None
    assert found['scale_factor_left'].value is not None
    assert [r.code for r in reasons] == ([code] if code else [])


def test_width_far_from_the_configured_one_is_reported():
    found, (reason,) = estimate(pair(width=1.72), odometer__track_width=1.6)
    assert found['track_width'].value == pytest.approx(1.72)
    assert reason.code is Code.TRACK_WIDTH_FAR_FROM_GIVEN
    # 3 sigma of a tape of 2 %: 0.096 m
    assert estimate(pair(width=1.69), odometer__track_width=1.6)[1] == []


def leg_of(wheels):
    return MethodResult('smoother', (), {}, details=wheel_result.wheel_details(wheels))


def test_several_legs_are_averaged_by_variance_and_widened_if_they_differ():
    one, other = pair(delta=2e-3, sigma=1e-5), pair(delta=2.01e-3, sigma=2e-5, width=1.601)
    left, right = wheel_result.combine_wheels([leg_of(one), leg_of({}), leg_of(other)]).values()
    weight = np.array([4.0, 1.0]) / 5
    both = [legs['left'].ratio for legs in (one, other)]
    assert left.ratio == pytest.approx(weight @ both, rel=1e-12)
    assert left.ratio_sigma == pytest.approx(1e-5 / np.sqrt(1.25))
    assert left.y - right.y == pytest.approx(1.6005)
    assert wheel_result.combine_wheels([leg_of({}), leg_of({})]) == {}
    legs = [leg_of(pair(delta=delta, sigma=1e-5)) for delta in (1e-3, 2e-3, 3e-3)]
    left, _ = wheel_result.combine_wheels(legs).values()
    # 0.1 % apart beside 10 ppm: their scatter dominates
    assert left.ratio_sigma == pytest.approx(1e-3 / np.sqrt(3), rel=0.01)
