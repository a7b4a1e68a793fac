# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pass or fail: the rule against the normal law, its limits, and what prevents a pass."""

from math import erf, pi, sqrt

import numpy as np
import pytest
from scipy.special import ndtri

from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.pipeline.acceptance import accept, decide, Decision
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.config_groups import parse_accept

pytestmark = pytest.mark.core
LIMITS = {'accept.scale_ratio_min': 0.995, 'accept.scale_ratio_max': 1.005}
CAUTION = Reason(Code.SPEED_TOO_LOW, 'slow')


def decided(value, sigma, reasons=(), name='scale_ratio', unit='1', **settings):
    estimates = {name: Estimate(value, sigma, unit)}
    return accept(Calibration(tuple(reasons), estimates, {}, ()),
                  with_settings(Config(), settings or LIMITS))


@pytest.mark.parametrize('place', [-4, -2, 0, 1, 4])
def test_shares_of_pass_and_fail_agree_with_the_normal_law(place):
    """A result with a sigma of 500 ppm, its true value so many sigma above the upper limit."""
    draws, sigma = 20_000, 500e-6
    z = ndtri((np.arange(draws) + 0.5) / draws)        # the law itself: no noise of drawing
    found = [decide(1.005 + (place + x) * sigma, sigma, 0.995, 1.005) for x in z]
    below = (1 + erf((-place - 2) / sqrt(2))) / 2
    # the lower limit is 20 sigma away; one draw is half of the tolerance
    assert found.count(Decision.PASS) / draws == pytest.approx(below, abs=1e-4)
    above = (1 + erf((place - 2) / sqrt(2))) / 2
    assert found.count(Decision.FAIL) / draws == pytest.approx(above, abs=1e-4)


def test_an_uncertain_value_is_undecided_and_states_the_sigma_required():
    assert decided(1.004, 0.0004).decision is Decision.PASS
    found = decided(1.004, 0.0006)
    assert found.decision is Decision.UNDECIDED
    assert found.values[0].required_sigma == pytest.approx(0.0005)
    assert 'about 2 times as many' in found.why      # (6 / 5)^2 = 1.44
    assert found.remedy == Code.SCALE_SIGMA_TOO_LARGE.remedy
    assert decided(1.0055, 0.0003).why == (
        'scale ratio is 1.0055, beyond its limit of 1.005 by less than 2 sigma (sigma 0.0003)')
    assert decided(1.0055, 0.0002).decision is Decision.FAIL


def test_limits_are_optional_on_each_side():
    estimates = {'scale_ratio': Estimate(1.0, 0.1, '1')}
    assert accept(Calibration((), estimates, {}, ()), Config()) is None
    one = {'accept.scale_ratio_max': 1.005}
    assert decided(0.5, 0.001, **one).decision is Decision.PASS
    assert decided(1.1, 0.001, **one).decision is Decision.FAIL
    with pytest.raises(BadConfig, match='not below'):
        with_settings(Config(), one | {'accept.scale_ratio_min': 1.005})


def test_limits_of_an_angle_near_180_deg_hold_across_the_wrap_around():
    limits = {'accept.yaw_mounting_angle_min': pi - 0.02, 'accept.yaw_mounting_angle_max':
              pi + 0.02}
    for value in (pi - 0.01, -pi + 0.01):
        found = decided(value, 0.001, name='yaw_mounting_angle', unit='rad', **limits)
        assert found.decision is Decision.PASS
    found = decided(-pi + 0.05, 0.001, name='yaw_mounting_angle', unit='rad', **limits)
    assert found.decision is Decision.FAIL
    del limits['accept.yaw_mounting_angle_min']        # texts are in degrees
    found = decided(-pi + np.deg2rad(3), np.deg2rad(2), name='yaw_mounting_angle', unit='rad',
                    **limits)
    assert 'is 183 deg, beyond its limit of 181.15 deg by less than 2 sigma (sigma 2 deg)' in (
        found.why)


def test_a_rejected_result_decides_nothing_and_strict_passes_no_caution():
    rejected = decided(1.0, 1e-4, [Reason(Code.ODOMETER_STILL, 'no counts')])
    assert rejected.decision is Decision.UNDECIDED
    assert 'ODOMETER_STILL: no counts' in rejected.why
    assert decided(1.0, 1e-4, [CAUTION]).decision is Decision.PASS
    strict = LIMITS | {'accept.strict': True}
    assert decided(1.0, 1e-4, [CAUTION], **strict).decision is Decision.UNDECIDED
    assert decided(1.0, 1e-4, **strict).decision is Decision.PASS
    assert decided(2.0, 1e-4, [CAUTION], **strict).decision is Decision.FAIL


def test_a_value_that_is_not_determined_gives_driving_instructions():
    why = Reason(Code.YAW_NOT_DETERMINED, 'too little')
    found = decided(None, None, [why], name='yaw_mounting_angle', unit='rad',
                    **{'accept.yaw_mounting_angle_max': 0.01})
    assert (found.decision, found.remedy) == (Decision.UNDECIDED, why.remedy)
    assert 'nominal_scale' in decided(None, None).remedy


def test_limits_of_angles_on_the_command_line_are_in_degrees():
    assert parse_accept('scale_ratio=0.995:1.005') == LIMITS
    assert parse_accept('yaw_mounting_angle_deg=-0.5:') == {
        'accept.yaw_mounting_angle_min': pytest.approx(-0.5 * pi / 180, rel=1e-15)}
    for wrong in ('scale_ratio', 'scale_ratio=1', 'scale_ratio=:', 'scale_ratio=a:b',
                  'scale_ratio=nan:1', 'scale_ratio_deg=1:2', 'speed=1:2'):
        with pytest.raises(BadUsage, match='--accept'):
            parse_accept(wrong)
