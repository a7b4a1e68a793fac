# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Delays, slip of a coarse speed, slow slip of one wheel: reported, and in the sigmas."""

import re
from types import SimpleNamespace

from drives import drive, reason_texts, seconds, settings, with_columns
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.beyond_model import delay_notes
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.methods import reasons_on_data
from odocal_ros.pipeline.prepared_leg import MethodRun
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.slow
ROUTE = {'scenario': 'town', 'duration': 180.0, 'seed': 6, 'two_wheels': True}
SAID = re.compile(r'(\w+) stamps are ([\d.]+) s \(± ([\d.]+) s\) (late|early).*? '
                  r'set (gnss|odometer)\.time_offset to (-?[\d.]+)')


def delay_texts(made, method, **changes):
    """Return a reported delay: (sensor, seconds late, sigma, setting, its value)."""
    result = calibrate(made.leg(), settings(made, method=method, heading_sigma=None, **changes))
    text = reason_texts(result).get(Code.DELAY_SEEN)
    if text is None:
        return None
    what, size, sigma, direction, name, offset = SAID.search(text).groups()
    return what, float(size) * (1 if direction == 'late'
                                else -1), float(sigma), name, float(offset)


@pytest.mark.parametrize(('late', 'sensor', 'setting', 'prior', 'options'), [
    (0.12, 'fix', 'gnss', 0.05, {'fix_delay': 0.12}),
    (-0.12, 'fix', 'gnss', 0.05, {'fix_delay': -0.12}),
    (0.04, 'odometer', 'odometer', 0.01, {'odometer_delay': 0.04, 'fix_noise': 'rtk'})])
def test_late_and_early_sensors_are_reported(late, sensor, setting, prior, options):
    made = drive(**ROUTE, **options)
    what, size, sigma, name, offset = delay_texts(made, 'smoother')
    assert (what, name) == (sensor, setting)
    # the prior of the delay, time_sigma, reduces it by (sigma / prior)^2 of itself
    pull = abs(late) * (sigma / prior)**2
    assert abs(size - late) < 4 * sigma + pull + 0.001
    assert offset == pytest.approx(-size, abs=0.001)
    assert delay_texts(made, 'smoother', **{f'{name}__time_offset': offset}) is None


def test_a_value_far_from_its_setting_is_determined_despite_a_tight_prior():
    made = drive(**ROUTE | {'duration': 300.0}, antenna_lever_arm=(0.0, 2.0, 0.0), fix_sigma=0.5)
    method = calibrate(made.leg(), settings(
        made, method='smoother', heading_sigma=None, gnss__lever_arm=(0.0, 0.0, 0.0),
        gnss__lever_arm_sigma=0.05)).methods['smoother']
    found = method.estimates['antenna_lever_arm_y']
    assert abs(found.value - 2.0) < 4 * found.sigma
    assert found.sigma > 0.05 / 2


def test_only_one_method_reports_a_delay_other_than_zero_and_the_configured_one():
    assert delay_texts(drive(**ROUTE), 'smoother') is None
    made = drive(**ROUTE, fix_delay=0.12)
    *_, offset = delay_texts(made, 'smoother', gnss__time_offset=0.05)
    assert delay_texts(made, 'smoother', gnss__time_offset=offset) is None
    result = calibrate(made.leg(), settings(made, method='all', heading_sigma=None))
    assert [r.code for r in result.reasons].count(Code.DELAY_SEEN) == 1


@pytest.mark.parametrize(('late', 'sigma', 'fix_sigma', 'is_said'), [
    (0.02, 0.005, 0.02, True),       # 0.2 m at 10 m/s, 4 sigmas
    (0.02, 0.008, 0.02, False),      # 2.5 sigmas
    (-0.009, 0.001, 0.02, False),    # 9 cm: as a lever arm error
    (0.02, 0.005, 1.5, False),       # not observable by 1.5 m fixes
    (-0.04, 0.005, 1.5, True)])
def test_a_delay_is_reported_if_significant_and_with_an_effect(late, sigma, fix_sigma, is_said):
    t = np.arange(0.0, 60.0, 0.1)
    run = SimpleNamespace(config=Config(), fix_sigma=fix_sigma, inputs=SimpleNamespace(
        travel=Travel(t, 20.0 * t, 0.0), t_stop=60.0, clock_delays={}))       # 10 m/s
    assert bool(delay_notes(run, {'gnss': (late, sigma)}, scale=0.5)) == is_said


SPUN, SLID = (Reason(Code.WHEEL_SLIP, f'the wheel {what}') for what in ('spun', 'slid'))
REJECTED = (Reason(Code.NOT_CONVERGED, 'it did not'),)
SPEED = {'scenario': 'town', 'odometer': 'speed', 'scale': 1.01, 'nominal_scale': 1.0,
         'duration': 200.0, 'imu_grade': 'industrial', 'seed': 7}


def run(name, odometer, reasons=()):
    method = MethodResult(name, reasons, {'scale_factor': Estimate(1.0, 0.01, '1')}, (), (), {})
    return MethodRun(method, odometer_reasons=odometer)


@pytest.mark.parametrize(('smoother', 'delay_texts'), [
    ([run('smoother', ())], []),                        # it fitted the leg without slip
    ([run('smoother', (SLID,))], [SLID]),
    ([run('smoother', None)], [SPUN]),                  # it does not estimate slip
    ([run('smoother', (), REJECTED)], [SPUN]),
    ([], [SPUN])])
def test_slip_is_from_the_smoother_where_the_smoother_gives_the_value(smoother, delay_texts):
    runs = (*smoother, run('two_point', (SPUN,), REJECTED))
    assert reasons_on_data({one.result.name: one for one in runs}, None) == delay_texts


def whole_kmh(leg, spun=0.0):
    """Return a leg of speeds in whole km/h, 10 Hz; spun: m in 2 s at 8 m/s and more."""
    t, value = seconds(leg, leg.odometer), leg.odometer.value
    fast = t[(value > 8.0) & (t > 60.0)][0]
    value = value + spun / 2.0 * ((t > fast) & (t < fast + 2.0))
    return with_columns(leg, 'odometer', value=(slice(None), np.trunc(3.6 * value) / 3.6)), fast


@pytest.mark.parametrize('spun', [0.0, 4.0])
def test_slip_of_a_coarse_speed_is_found_by_the_track_of_the_smoother(spun):
    made = drive(**SPEED)
    leg, at = whole_kmh(made.leg(), spun)
    result = calibrate(leg, settings(made, None, method='auto'))
    delay_texts = [r.text for r in result.reasons if r.code is Code.WHEEL_SLIP]
    assert len(delay_texts) == (spun > 0)
    if spun:
        assert float(delay_texts[0].split('t = ')[1].split(' s')[0]) == pytest.approx(at + 1.0,
                                                                                      abs=1.5)
    assert Code.SPEED_COARSE in reason_texts(result)


STRAIGHT = {'scenario': 'straight', 'duration': 400.0, 'two_wheels': True, 'seed': 3}
SLIP_M = 20.0
WHEELS = ('scale_factor_left', 'scale_factor_right')


def with_slip(made, extra_m):
    """Return the leg with extra_m(t, share of the path) more metres on the right wheel."""
    leg, count = made.leg(), made.odometer_right.value
    share = (count - count[0]) / (count[-1] - count[0])
    more = extra_m(seconds(leg, leg.odometer_right), share) / made.truth.wheel_scales[1]
    return with_columns(leg, 'odometer_right', value=lambda n: n + np.round(more).astype(np.int64))


def slow(made):
    """Return the leg with a slip of one per cent in the second half of the path."""
    return with_slip(made, lambda t,
                     share: 0.01 * made.truth.distance * np.clip(share - 0.5, 0, None))


def drawn_out(made):
    """Return the leg with a slip of twenty metres within forty seconds about the middle."""
    return with_slip(made, lambda t, share: SLIP_M * np.clip(
        (t - np.interp(0.5, share, t)) / 40.0 + 0.5, 0.0, 1.0))


@pytest.fixture(scope='module', params=[slow, drawn_out], ids=['slow', 'drawn out'])
def slipped(request):
    made = drive(**STRAIGHT)
    return made, request.param, calibrate(request.param(made), settings(made, method='all'))


@pytest.mark.parametrize('method', ['two_point', 'smoother'])
def test_slow_slip_is_within_the_sigma_of_each_method(slipped, method):
    made, _, result = slipped
    estimates = result.methods[method].estimates
    truth = dict(zip(('scale_factor', *WHEELS), (made.truth.scale, *made.truth.wheel_scales),
                     strict=True))
    for name in truth.keys() & estimates.keys():
        e = estimates[name]
        # without slip the error is 0.1 sigma: all of it is this slip or a share of it
        assert abs(e.value - truth[name]) < 1.5 * e.sigma, name
        assert e.sigma < 0.01 * e.value
    ratio = estimates['scale_ratio']
    assert ratio.sigma / ratio.value == pytest.approx(
        estimates['scale_factor'].sigma / estimates['scale_factor'].value, rel=1e-6)


def test_the_sigma_of_slip_is_in_the_budget(slipped):
    _, _, result = slipped
    for name, method in result.methods.items():
        e = method.estimates['scale_factor']
        row = method.parameters.index('scale_factor')
        of_sources = np.sqrt(sum((s.effects[row]**2).sum() for s in method.sources))
        assert e.sigma / e.value == pytest.approx(of_sources, rel=1e-6), name
        budget = np.sqrt(sum(line['scale_factor']**2
                             for line in method.details['budget'].values()))
        assert budget == pytest.approx(e.sigma, rel=1e-6), name


def test_slow_slip_is_reported_with_its_size(slipped):
    _, how, result = slipped
    text = next(r.text for r in result.reasons if r.code is Code.WHEEL_SLIP)
    if how is slow:
        assert 'the right wheel counts 1.0' in text
        assert ('0.25 % is added to the uncertainty of the scale, 0.50 % to that of each '
                'wheel') in text
    else:
        assert 1800 < float(text.split(' cm')[0].split()[-1]) < 2200
    # 0.25 % exceeds the required accuracy of 0.1 %; settings of these tests require 10 %
    assert Code.SCALE_SIGMA_TOO_LARGE not in reason_texts(result)


def test_a_sigma_increased_by_slip_is_compared_with_its_limit():
    made = drive(**STRAIGHT)
    result = calibrate(slow(made), settings(made, method='smoother',
                                            verdict__max_scale_sigma=1e-3))
    text, = (r.text for r in result.methods['smoother'].reasons
             if r.code is Code.SCALE_SIGMA_TOO_LARGE)
    assert float(text.split()[3]) > 2400           # ppm
    made = drive(**STRAIGHT)
    result = calibrate(made.leg(), settings(made, method='all'))
    assert not any(s.name == 'slow_wheel_slip' for m in result.methods.values() for s in m.sources)
