# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sensors whose clocks run at rates of their own."""

from dataclasses import replace

import pytest
from smoother_legs import made

from odocal_ros.estimator.smoother import smooth
from odocal_ros.reasons import Code
from odocal_ros.sim.real import Real

pytestmark = pytest.mark.slow
FAST = 1e-4         # relative


@pytest.fixture(scope='module', params=['fix', 'odometer'])
def drifting(request):
    """Return the name, the drive and the result of a leg in motion with one fast clock."""
    name = request.param
    drive, config, leg = made(scenario='town', fix_noise='rtk', fix_sigma=0.01,
                              duration=300.0, real=Real(**{f'{name}_clock_rate': FAST}))
    return name, drive, smooth(replace(leg, t_begin=60.0, t_stop=240.0), config)


def test_the_scale_is_that_of_the_wheel(drifting):
    _, drive, result = drifting
    scale = result.estimates['scale_factor']
    assert abs(scale.value - drive.truth.scale) < 3 * scale.sigma
    assert scale.sigma / scale.value < FAST / 3     # an error of FAST would show


def test_the_rate_is_stated(drifting):
    name, _, result = drifting
    text, = (r.text for r in result.reasons if r.code is Code.CLOCKS_DRIFT)
    ppm = int(text.split('clock is ')[1].split(' ppm')[0])
    sigma = int(text.split('(± ')[1].split(')')[0])
    assert text.startswith(f'{name} stamps')
    assert 'fast' in text
    assert abs(ppm - 1e6 * FAST) <= 3 * sigma + 1    # rounded to whole ppm
    assert not {Code.WHEEL_SLIP, Code.SCALE_VARIES, Code.FIXES_NOISIER_THAN_SAID} & {
        r.code for r in result.reasons}


def test_clocks_that_agree_are_not_named():
    _, config, leg = made(scenario='town', fix_noise='rtk', fix_sigma=0.01, duration=300.0)
    assert Code.CLOCKS_DRIFT not in {r.code for r in smooth(leg, config).reasons}
