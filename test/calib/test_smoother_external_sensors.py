# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Velocity, heading and air pressure from other sensors in the smoother."""

from dataclasses import replace
import math

from drives import changed, off
import numpy as np
import pytest
from smoother_legs import (
    leg_of,
    made,
    reason_texts,
    smoothed,
    truth,
    VELOCITY_SIGMA as SIGMA,
    with_velocity,
)

from odocal_ros.estimator import cramer_rao_bound, smooth
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.point_rows import rows_per_independent
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.state import PRESSURE, YAW
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import with_settings

pytestmark = pytest.mark.slow
BOTH = 'scale_factor', 'yaw_mounting_angle'
ARMS = {'antenna_lever_arm': (0.5, -0.3, 1.2)}
SHORT = {'duration': 200.0, 'imu_grade': 'industrial'} | ARMS
STRAIGHT = {'scenario': 'straight', 'duration': 300.0, 'imu_grade': 'industrial'}
HILLS = {'slope': np.deg2rad(2.0), 'pressure_sigma': 0.15}
HILLY = {'duration': 240.0, 'imu_grade': 'consumer', 'fix_noise': 'correlated'} | HILLS


def fitted(leg, config, **changes):
    config = with_settings(config, {k.replace('__', '.'): v for k, v in changes.items()})
    return smooth(leg_of(leg, config), config)


def sigma_of(method, name='scale_factor'):
    e = method.estimates[name]
    return e.sigma / e.value if name == 'scale_factor' else e.sigma


def test_external_rows_vanish_at_the_truth():
    drive, config, _ = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0,
                            heading_sigma=0.0, **ARMS)
    leg = replace(leg_of(with_velocity(drive, lambda e: 0 * e), config), t_stop=60.0)
    problem, state = make_problem(leg, config), truth(drive, config, leg)
    parts = Equations(problem, state).factors
    # 50 Hz: a turn rate is a mean over 20 ms, error 5 mrad/s at 0.5 rad/s^2, on an arm of 0.6 m
    assert np.abs(parts['velocity'].raw).max() < 5e-3
    # within a step of 20 ms the turn is of first order: (0.02 s 0.5 rad/s)^2 / 2
    assert np.abs(parts['heading'].raw).max() < 1e-4


def test_velocity_reduces_the_sigma_and_its_noise_is_found():
    drive, without = smoothed(**SHORT)
    config = made(**SHORT)[1]
    pure = with_settings(config, {'gnss.velocity_scale_sigma': 1e-5})
    measured = fitted(with_velocity(drive, lambda e: SIGMA * e), pure)
    silent = fitted(with_velocity(drive, lambda e: SIGMA * e, 0.0), pure)
    assert off(measured, drive, *BOTH) < 3.3
    assert sigma_of(measured) < 0.9 * sigma_of(without)
    # 1500 draws of each: 2 % of a sigma
    assert measured.details['noise']['velocity'] == pytest.approx(1.0, abs=0.08)
    assert silent.details['noise']['velocity'] == pytest.approx(0.5, abs=0.04)
    assert sigma_of(silent) == pytest.approx(sigma_of(measured), rel=0.02)
    assert any(s.name == 'fix_velocity' for s in measured.sources)
    assert not {'fix_velocity', 'heading'} & {s.name for s in without.sources}


def test_velocity_outliers_do_not_shift_the_values():
    drive, config, _ = made(**SHORT)

    def errors(e):
        bad = np.arange(len(e)) % 50 == 0
        return SIGMA * e + 5.0 * bad[:, None]

    method = fitted(with_velocity(drive, errors), config)
    assert off(method, drive, *BOTH) < 3.3
    # 2 % of the rows at the limit of full weight, 9 instead of 1: 1.18 in variance
    assert method.details['noise']['velocity'] < 1.18


def test_correlated_velocity_errors_do_not_reduce_the_sigma():
    drive, config, _ = made(**SHORT)

    def slow(e):
        out = np.empty_like(e)
        x = e[0]
        for i, draw in enumerate(e):
            x = 0.95 * x + np.sqrt(1 - 0.95**2) * draw
            out[i] = SIGMA * x
        return out

    method = fitted(with_velocity(drive, slow), config)
    # adjacent rows have a correlation of 0.95: (1 + 0.95) / (1 - 0.95) = 39 count as one, fewer
    # where the smoother attributes them to motion
    assert 10 < method.details['external']['velocity']['rows_per_independent'] < 80
    assert off(method, drive, *BOTH) < 3.3


@pytest.mark.parametrize(('error', 'name', 'true', 'sigma'), [
    ({'velocity_delay': 0.2}, 'velocity_delay', 0.2, 0.05),
    ({'velocity_lag': 0.5}, 'velocity_lag_square', 0.25, 0.0625),
    ({'velocity_scale_error': 1e-3}, 'velocity_scale', 1e-3, 1e-3),     # from the prior only
    ({'velocity_scale_error': 0.02}, 'velocity_scale', 0.02, 0.005)])   # of a fused velocity
def test_receiver_errors_in_a_velocity_are_found_and_do_not_bias_the_fit(error, name, true, sigma):
    drive, method = smoothed(**SHORT, velocity_sigma=SIGMA, **error)
    found = method.details['external']['velocity'][name]
    assert abs(found['value'] - true) < 3.3 * found['sigma']
    assert found['sigma'] <= sigma
    assert off(method, drive, *BOTH) < 3.3


def test_velocity_delay_is_found_despite_vibration():
    # derivatives by single samples contain vibration: a wrong delay with a small sigma
    drive, config, _ = made(**SHORT, velocity_sigma=SIGMA, velocity_delay=0.3)
    leg = drive.leg()
    shake = 2.0 * np.random.default_rng(3).standard_normal(leg.imu.f_i.shape)
    leg = replace(leg, imu=changed(leg.imu, f_i=lambda f: np.add(f, shake, out=f)))
    found = smooth(leg_of(leg, config), config).details['external']['velocity']['velocity_delay']
    assert found['value'] == pytest.approx(0.3, abs=3.3 * found['sigma'])
    assert found['sigma'] < 0.08        # a third of the prior sigma


def test_unusable_or_unselected_sensors_are_left_out():
    drive, config, leg = made(**SHORT, **HILLS, velocity_sigma=SIGMA, orientation_sigma=1e-3)
    assert set(leg.external) == {'velocity', 'pressure'}     # no orientation unless selected
    without = with_settings(config, {'gnss.use_velocity': False, 'imu.use_pressure': False})
    assert not leg_of(drive.leg(), without).external
    assert 'pressure' not in without.inputs
    silent = replace(drive.leg(), imu=changed(drive.imu, f_i=lambda f: f.fill(0.0)))
    assert not leg_of(silent, config).external


def test_white_errors_are_not_correlated():
    rng = np.random.default_rng(3)

    class White:
        r, weight = rng.standard_normal((1000, 3)), np.ones((1000, 3))

    # the largest of seven ratios of chi2 with 24 to 1000 degrees of freedom: 1 + 3 / sqrt(12)
    assert rows_per_independent(White) < 1.9


@pytest.mark.parametrize('how', ['topic', 'fixed', 'imu'])
def test_heading_adds_only_the_information_of_its_sigma(how):
    sigma = 1e-3
    options = {'topic': {'heading_sigma': sigma}, 'imu': {'orientation_sigma': sigma}}
    drive, config, leg = made(**STRAIGHT, **options.get(how, {}))
    ask = {'topic': {}, 'imu': {'alignment__heading_source': 'imu_orientation'},
           'fixed': {'alignment__heading': float(drive.truth.heading),
                     'alignment__heading_sigma': sigma}}[how]
    method = fitted(drive.leg(), config, **ask)
    # without the heading, at the noise levels of this fit: a separate fit finds other levels
    levels = Levels.from_sigmas(method.details['noise'])
    alone = math.sqrt(cramer_rao_bound(replace(leg, external={}), config,
                                       truth(drive, config, leg), levels)[YAW, YAW])
    # two independent sources; linearised at the estimate or at the truth: 3 %. A heading that the
    # drive contradicts, here by 1.5 of its sigmas, has less weight: up to 15 %
    both = 1 / np.hypot(1 / sigma, 1 / alone)
    assert 0.97 * both < sigma_of(method, 'yaw_mounting_angle') < 1.15 * both
    assert off(method, drive, *BOTH) < 3.3
    assert method.details['external']['heading']['source'].startswith(how[:3]) or how == 'topic'
    shared = {s.name for s in method.sources if s.shared}
    assert 'heading' in shared


def test_wrong_heading_is_reported_and_relaxed():
    drive, config, _ = made(**SHORT)
    method = fitted(drive.leg(), config, alignment__heading=float(drive.truth.heading) + 0.05,
                    alignment__heading_sigma=2e-3)
    assert 'heading (fixed) differs by' in reason_texts(method)[Code.MODEL_MISMATCH]
    remedy, = (r.remedy for r in method.reasons if r.code is Code.MODEL_MISMATCH)
    assert 'alignment.heading' in remedy
    assert 'height' not in remedy
    assert off(method, drive, *BOTH) < 3.3


def test_rows_with_impossible_values_are_left_out():
    drive, config, _ = made(**HILLY)
    leg = with_velocity(drive, lambda e: 0 * e)
    sent, pressure = leg.rows('fix_velocity'), leg.rows('pressure')

    def spoil(v):
        v[5:8, 0] = np.nan

    leg = leg.with_rows(fix_velocity=changed(sent, velocity_n=spoil),
                        pressure=replace(pressure, value=pressure.value / 100))     # in hPa
    inputs, found = screen(leg, config)
    assert len(inputs.external['fix_velocity'].t) == len(sent.stamp_ns) - 3
    assert any('3 of' in r.text and 'GNSS velocity messages' in r.text for r in found)
    assert not len(inputs.external['pressure'].t)
    assert any('air pressure messages hold NaN, Inf or an impossible value' in r.text
               for r in found)
    assert 'pressure' not in leg_of(leg, config).external


def test_pressure_rows_vanish_at_the_truth_except_for_the_constants():
    drive, config, _ = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0,
                            **HILLS | {'pressure_sigma': 0.0})
    leg = replace(leg_of(drive.leg(), config), t_stop=60.0)
    problem, state = make_problem(leg, config), truth(drive, config, leg)
    part = Equations(problem, state).factors['pressure']
    _, by_constants = part.jacobians(16)
    by = by_constants[:, 0, PRESSURE]
    left = part.raw[:, 0] - by @ np.linalg.lstsq(by, part.raw[:, 0], rcond=None)[0]
    # mean of twenty heights in 1 s, 4 m/s^2 upwards at most at a change of slope: 4 / 24 m
    assert np.abs(left).max() < 4 / 24
    assert np.ptp(problem.external['pressure'].height) > 1.0


def test_heights_improve_the_pitch_within_its_sigma():
    pitch, errors, gain = 'pitch_mounting_angle', [], []
    for seed in range(1, 7):
        drive, config, leg = made(**HILLY, seed=seed)
        found, without = smooth(leg, config), smooth(replace(leg, external={}), config)
        errors.append(off(found, drive, pitch))
        gain.append(sigma_of(found, pitch) / sigma_of(without, pitch))
        assert off(found, drive) < 3.3
        # the air temperature is unknown by 15 K, 5 % of a height: no scale information
        assert sigma_of(found) > 0.8 * sigma_of(without)
        assert 'air_pressure' in {s.name for s in found.sources}
    # chi^2 of 6 at 1 in 1000. The vehicle is ideal; the sigma also covers bodies that pitch
    assert np.sum(np.square(errors)) < 22.5
    assert np.median(gain) < 0.8


def test_pressure_noise_level_is_found():
    level = smoothed(**HILLY | {'pressure_sigma': 0.3}, seed=3)[1].details['noise']['pressure']
    # 240 means of 1 s: 1 / sqrt(2 * 240) of a sigma, and a mean over 1 s of hills
    assert level == pytest.approx(1.0, abs=3.3 / np.sqrt(480))


def test_doors_and_tunnels_are_outliers():
    """A slammed door or a tunnel: 30 to 300 Pa for seconds."""
    drive, config, _ = made(**HILLY, seed=2)
    sent = drive.leg().rows('pressure')
    value = sent.value + np.where(np.arange(len(sent.value)) % 800 < 40, 300.0, 0.0)
    leg = leg_of(drive.leg().with_rows(pressure=replace(sent, value=value)), config)
    assert off(smooth(leg, config), drive, 'pitch_mounting_angle') < 3.3
