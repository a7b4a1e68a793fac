# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs that one vehicle cannot have driven are rejected together, others are not."""

import numpy as np
import pytest

from odocal_ros.calib.one_vehicle import unlike_legs
from odocal_ros.calib.result import Estimate, LegResult, MethodResult, Source
from odocal_ros.pipeline.combination import combine
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import Config

DEG = np.pi / 180


def leg(number, scale=0.02, sigma=2e-6, yaw=0.01, yaw_sigma=1e-4, unit='m/pulse'):
    """Return a leg of an hour of its own, accepted."""
    estimates = {'scale_factor': Estimate(scale, sigma, unit),
                 'scale_ratio': Estimate(None, None, '1'),
                 'yaw_mounting_angle': Estimate(yaw, yaw_sigma, 'rad'),
                 'pitch_mounting_angle': Estimate(None, None, 'rad')}
    start = number * 3600 * 10**9
    return LegResult(start, start + 10**11, 1000.0, 100.0, 1, 1, 1, 0, (), {
        'two_point': MethodResult(
            'two_point', (), estimates, ('scale_factor', 'yaw_mounting_angle'),
            (Source('fixes', np.diag([sigma, yaw_sigma])),), {})}, C_bi=np.eye(3))


def said(*legs):
    return [r.text for r in unlike_legs(list(enumerate(legs, 1)))]


def test_legs_of_one_vehicle_are_fine():
    # worn and new tyres, a mounting given 4 deg of play: LEGS_DISAGREE says it and widens
    assert said(leg(1), leg(2, scale=0.0206, yaw=0.01 + 4 * DEG)) == []
    assert said(leg(1)) == said() == []


def test_legs_of_two_vehicles_are_named_by_scale_mounting_and_unit():
    text, = said(leg(1, scale=0.0203), leg(2, scale=0.02), leg(3, scale=0.022))
    assert text.startswith('the scale of leg 3 is 10.0 % above that of leg 2: larger than')
    text, = said(leg(1), leg(2, yaw=0.01 - 6 * DEG))
    assert text.startswith('the yaw mounting of leg 1 is 6.0 deg above that of leg 2')
    text, = said(leg(1), leg(2, scale=0.03, yaw=0.5))
    assert ' and the yaw mounting of leg 2 is ' in text
    text, = said(leg(1), leg(2, scale=1.02, sigma=1e-4, unit='1'), leg(3))
    assert text.endswith('so their scales cannot be combined: m/pulse in leg 1, 3; 1 in leg 2')


def test_an_imu_that_faces_backwards_is_one_vehicle():
    assert said(leg(1, yaw=179.9 * DEG), leg(2, yaw=-179.9 * DEG)) == []
    text, = said(leg(1, yaw=177 * DEG), leg(2, yaw=-177 * DEG))
    assert text.startswith('the yaw mounting of leg 2 is 6.0 deg above that of leg 1')


@pytest.mark.parametrize('more', [
    {'scale': 0.03, 'sigma': 0.0021}, {'yaw': 0.5, 'yaw_sigma': 0.1}, {'yaw': None}])
def test_what_sigmas_allow_is_no_other_vehicle(more):
    assert said(leg(1), leg(2, **more)) == []


def test_the_combination_is_rejected_or_its_sigma_judged():
    whole = combine([leg(1), leg(2, scale=0.03)], Config())
    assert whole.verdict is Verdict.REJECTED
    assert [r.code for r in whole.reasons if r.code.gravity is Verdict.REJECTED] == [
        Code.LEGS_UNLIKE]
    # 3 % apart: one vehicle, but a mean good to no 0.1 %
    whole = combine([leg(1), leg(2, scale=0.0206)], Config())
    assert {Code.LEGS_DISAGREE, Code.SCALE_SIGMA_TOO_LARGE} <= {r.code for r in whole.reasons}
    assert whole.verdict is Verdict.CAUTION
