# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Coarse speeds and counters in the whole pipeline: within sigma, named, and not slip."""

from dataclasses import replace

from drives import cached, off, reason_texts, settings
import numpy as np
import pytest

from odocal_ros.calib.joint import fit_jointly
from odocal_ros.data.samples import OdometerSamples
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
KMH = 1 / 3.6
SEED = 31


@cached
def calibrated(how='floor', rate=10.0, step=KMH, between=0.0, **options):
    """Return a drive and its result; between: Hz to which the speeds are interpolated."""
    drive = simulate(SimOptions(**({
        'scenario': 'town', 'odometer': 'speed', 'scale': 1.01, 'nominal_scale': 1.0,
        'odometer_rate': rate, 'imu_rate': 50.0, 'duration': 300.0, 'seed': SEED,
        'real': RealEffects(speed_step=step, speed_rounding=how)} | options)))
    leg = drive.leg()
    if between:
        ns, v = leg.odometer.stamp_ns, leg.odometer.value
        more = np.arange(ns[0], ns[-1], round(1e9 / between))
        leg = replace(leg, odometer=OdometerSamples(more, more, np.interp(
            more - ns[0], ns - ns[0], v)))
    return drive, calibrate(leg, settings(drive, None, method='auto'))


def relative_sigma(drive, method):
    return method.estimates['scale_factor'].sigma / drive.truth.scale


@pytest.mark.parametrize(('rate', 'between', 'most'), [
    (10.0, 0.0, 1.7e-3), (1.0, 0.0, 4e-3), (1.0, 10.0, 5e-3)])
@pytest.mark.parametrize('how', ['floor', 'round'])
def test_scale_error_of_a_speed_in_whole_kmh_is_within_its_sigma(how, rate, between, most):
    drive, result = calibrated(how, rate, between=between)
    assert off(result.methods['smoother'], drive) < 3.3
    # the sum of truncated speeds has an error of 1.4 %; five minutes have half the steps of ten,
    # and a filter of the speed is an additional unknown
    assert relative_sigma(drive, result.methods['smoother']) < most
    assert off(result.methods['two_point'], drive) < 2.0
    seen = reason_texts(result)
    assert Code.SPEED_COARSE in seen
    assert Code.WHEEL_SLIP not in seen


@pytest.mark.parametrize('tau', [0.4, 0.8])
def test_filter_before_the_steps_is_found(tau):
    real = RealEffects(speed_step=KMH / 2, speed_rounding='floor', speed_filter=tau)
    drive, result = calibrated(real=real, odometer_rate=5.0, duration=600.0)
    method = result.methods['smoother']
    assert off(method, drive) < 3.3
    assert Code.SPEED_FILTERED in reason_texts(result)
    found = method.details['odometer_lag_square']
    # 15 % of the time constant: a first-order filter by five speeds
    assert abs(found['value'] - tau**2) < 0.3 * tau**2 + 3.3 * found['sigma']


@pytest.mark.parametrize('how', ['floor', 'round'])
def test_factor_as_sent_gives_the_path_length_of_the_sent_speeds(how):
    drive, result = calibrated(how, 10.0)
    exact = simulate(replace(drive.options, real=RealEffects())).leg().odometer.value
    ratio = exact.sum() / drive.leg().odometer.value.sum()
    assert (ratio > 1.01) == (how == 'floor')
    found = result.methods['smoother'].estimates['scale_factor_as_sent']
    assert abs(found.value - drive.truth.scale * ratio) < 3 * found.sigma
    # the calibrated track uses the sent speeds: otherwise the error at the end is 1.4 % of 1.5 km
    assert result.after.percent_of_distance < 0.5
    assert found.sigma < 2e-3
    # the stated distance, too: the factor of the exact speed gives 1.4 % less
    assert abs(result.distance / drive.truth.distance - 1) < 3 * found.sigma / found.value + 1e-3


YARD = {'scenario': 'yard', 'duration': 400.0, 'imu_grade': 'industrial', 'fix_noise': 'rtk',
        'fix_sigma': 0.02}


@pytest.mark.parametrize(('options', 'most'), [
    # squat and turns change the direction of the path, without information on the scale
    ({'rate': 1.0, 'real': RealEffects(speed_step=KMH, squat=0.002, sideslip=0.004)}, 0.04),
    # the first and last interval of a motion are only partly in motion
    *(({'rate': 50.0, 'step': 0.1 * KMH, 'seed': seed}, np.inf) for seed in (33, 35))], ids=str)
def test_scale_error_in_a_yard_with_many_stops_is_within_its_sigma(options, most):
    drive, result = calibrated(**YARD, **options)
    assert off(result.methods['smoother'], drive) < 3.3
    assert relative_sigma(drive, result.methods['smoother']) < most


@pytest.mark.parametrize(('how', 'share'), [('floor', 0.5), ('round', 0.0)])
def test_truncation_and_rounding_are_distinguished(how, share):
    _, result = calibrated(how)
    offset = result.methods['smoother'].details['speed_offset']
    assert offset['value'] == pytest.approx(share * KMH, abs=3 * offset['sigma'])
    assert offset['sigma'] < KMH / 20
    assert 'resolution is 0.278 m/s (1 km/h)' in reason_texts(result)[Code.SPEED_COARSE]


def test_truncation_found_in_one_leg_holds_in_a_leg_without_information():
    _, result = calibrated()
    marginal = result.methods['smoother'].marginal
    offset = marginal.names.index('speed_offset')
    # rounding and truncation are equally likely before the drive
    prior = {name: np.where(np.arange(len(marginal.names)) == offset, KMH / 4,
                            getattr(marginal, name))
             for name in ('prior_mean', 'prior_sigma', 'relaxed_sigma')}
    empty = replace(marginal, information=np.zeros_like(marginal.information),
                    gradient=np.zeros_like(marginal.gradient), **prior)
    alone, both = (fit_jointly(legs, [0.0] * (len(legs) - 1), same_drive=[True] * (len(legs) - 1))
                   for legs in ([marginal], [marginal, empty]))
    assert both.value[offset] == pytest.approx(KMH / 2, abs=KMH / 500)
    scale = marginal.names.index('scale_factor')
    np.testing.assert_allclose(both.covariance[scale, scale], alone.covariance[scale, scale],
                               rtol=1e-4)     # the shortest random walk


@pytest.mark.parametrize('nominal', [KMH, 1.0])
def test_step_of_a_topic_in_kmh_is_stated_in_its_unit(nominal):
    """With the default of the nominal scale, 1, the fixes determine the unit."""
    _, result = calibrated(scale=KMH, nominal_scale=nominal, step=1.0)
    assert 'resolution is 1 km/h (0.278 m/s)' in reason_texts(result)[Code.SPEED_COARSE]


def test_continuous_speed_has_no_steps():
    _, result = calibrated(step=0.0)
    smoother = result.methods['smoother']
    assert Code.SPEED_COARSE not in reason_texts(result)
    assert smoother.details['speed_offset']['value'] == 0.0
    assert 'speed_truncation' not in {s.name for s in smoother.sources}


def test_steps_too_fine_for_crossings_have_an_offset():
    # 0.06 km/h truncated is 0.1 % of the path length: 800 ppm at this speed
    drive, result = calibrated(step=0.06 * KMH, rate=50.0)
    smoother = result.methods['smoother']
    assert off(smoother, drive) < 3.3
    assert smoother.details['noise'].keys().isdisjoint({'steps'})
    offset = smoother.details['speed_offset']
    assert offset['value'] == pytest.approx(0.03 * KMH, abs=4 * offset['sigma'])


@pytest.mark.parametrize('seed', [12, 15])
def test_scales_of_imu_and_odometer_do_not_shrink_together(seed):
    """With multipath, only the steps determine their common scale; residuals in m/s reduced it."""
    real = RealEffects(speed_step=KMH, slow_errors=((4.0, 40.0), (3.0, 300.0)), bursts=60.0,
                       burst_size=20.0)
    drive = simulate(SimOptions(
        scenario='town', duration=900.0, imu_grade='consumer', odometer='speed', odometer_rate=5.0,
        odometer_delay=0.3, fix_rate=1.0, fix_sigma=2.0, seed=seed, real=real))
    found = calibrate(drive.leg(), settings(drive, None, method='auto')).methods['smoother']
    assert off(found.estimates, drive, 'scale_factor') < 3     # with the published speeds: 6


def test_rounding_at_constant_speed_is_in_the_sigma():
    errors = []
    for seed in range(4):
        drive, result = calibrated('round', 20.0, 0.056 * KMH, scenario='yard', seed=seed,
                                   imu_grade='industrial', fix_noise='rtk', fix_sigma=0.01)
        smoother = result.methods['smoother']
        errors.append(off(smoother, drive))
        assert 'speed_steps' in {s.name for s in smoother.sources}
    # the sum of four squares is below 18.5 in 999 of 1000
    assert (np.array(errors)**2).sum() < 18.5, errors


def test_half_metre_pulses_are_named_and_are_not_slip():
    drive, result = calibrated(odometer='counts', rate=50.0, step=0.0, scale=0.505,
                               nominal_scale=0.5)
    seen = reason_texts(result)
    assert Code.COUNTER_COARSE in seen
    assert Code.WHEEL_SLIP not in seen
    assert off(result.methods['smoother'], drive) < 3.3
