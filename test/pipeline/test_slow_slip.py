# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A slip of one wheel that lasts: sized whole, said, and in the sigma of every method."""

from dataclasses import replace

from drives import drive, everything_said, settings
import numpy as np
import pytest

from odocal_ros.data.samples import OdometerSamples
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code

pytestmark = pytest.mark.slow
ROUTE = {'scenario': 'straight', 'duration': 400.0, 'two_wheels': True, 'seed': 3}
SLIP_M = 20.0
WHEELS = ('scale_factor_left', 'scale_factor_right')


def with_slip(made, extra_m):
    """Return the leg, extra_m(t, way) more metres counted by the right wheel; way from 0 to 1."""
    leg, right = made.leg(), made.odometer_right
    t = (right.stamp_ns - leg.start_ns) * 1e-9
    way = (right.value - right.value[0]) / (right.value[-1] - right.value[0])
    more = extra_m(t, way) / made.truth.wheel_scales[1]
    return replace(leg, odometer_right=OdometerSamples(
        right.stamp_ns, right.received_ns, right.value + np.round(more).astype(np.int64)))


def slow(made):
    """One per cent from half of the way on."""
    return with_slip(made, lambda t, way: 0.01 * made.truth.distance * np.clip(way - 0.5, 0, None))


def drawn_out(made):
    """Twenty metres within forty seconds about the middle."""
    return with_slip(made, lambda t, way: SLIP_M * np.clip(
        (t - np.interp(0.5, way, t)) / 40.0 + 0.5, 0.0, 1.0))


@pytest.fixture(scope='module', params=[slow, drawn_out], ids=['slow', 'drawn out'])
def slipped(request):
    made = drive(**ROUTE)
    return made, request.param, calibrate(request.param(made), settings(made, method='all'))


@pytest.mark.parametrize('method', ['two_point', 'smoother'])
def test_the_sigma_of_each_method_holds_it(slipped, method):
    made, _, result = slipped
    estimates = result.methods[method].estimates
    truth = dict(zip(('scale_factor', *WHEELS), (made.truth.scale, *made.truth.wheel_scales),
                     strict=True))
    for name in truth.keys() & estimates.keys():
        e = estimates[name]
        # without any slip the error would be 0.1 sigma: it is all of this slip, whole or less
        assert abs(e.value - truth[name]) < 1.5 * e.sigma, name
        assert e.sigma < 0.01 * e.value
    ratio = estimates['scale_ratio']
    assert ratio.sigma / ratio.value == pytest.approx(
        estimates['scale_factor'].sigma / estimates['scale_factor'].value, rel=1e-6)


def test_the_sigma_is_that_of_the_sources_and_in_the_budget(slipped):
    _, _, result = slipped
    for name, method in result.methods.items():
        e = method.estimates['scale_factor']
        row = method.parameters.index('scale_factor')
        of_sources = np.sqrt(sum((s.effects[row]**2).sum() for s in method.sources))
        assert e.sigma / e.value == pytest.approx(of_sources, rel=1e-6), name
        budget = np.sqrt(sum(line['scale_factor']**2
                             for line in method.details['budget'].values()))
        assert budget == pytest.approx(e.sigma, rel=1e-6), name


def test_it_is_said_with_its_size(slipped):
    _, how, result = slipped
    text = next(r.text for r in result.reasons if r.code is Code.WHEEL_SLIP)
    if how is slow:
        assert 'the right wheel counts 1.0' in text
        assert ('0.25 % is added to the uncertainty of the scale, 0.50 % to that of each '
                'wheel') in text
    else:
        assert 1800 < float(text.split(' by ')[1].split(' cm')[0]) < 2200
    # 0.25 % is more than the 0.1 % asked for: settings of these tests ask for 10 %
    assert Code.SCALE_SIGMA_TOO_LARGE not in everything_said(result)


def test_a_widened_sigma_is_judged_again():
    made = drive(**ROUTE)
    result = calibrate(slow(made), settings(made, method='smoother',
                                            verdict__max_scale_sigma=1e-3))
    text, = (r.text for r in result.methods['smoother'].reasons
             if r.code is Code.SCALE_SIGMA_TOO_LARGE)
    assert float(text.split()[3]) > 2400           # ppm


def test_without_slip_nothing_is_widened():
    made = drive(**ROUTE)
    result = calibrate(made.leg(), settings(made, method='all'))
    assert not any(s.name == 'slow_wheel_slip' for m in result.methods.values()
                   for s in m.sources)
