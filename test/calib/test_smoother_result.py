# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Smoother results on simulated legs: near the truth, from any start, rejected if required."""

from dataclasses import replace
from importlib import import_module
import re
from types import SimpleNamespace

from drives import ANGLES, changed, off
import numpy as np
import pytest
from smoother_legs import leg_of, made, reason_texts, smoothed, truth

from odocal_ros.calib.budget import total_covariance
from odocal_ros.estimator import smooth
from odocal_ros.estimator.cold_start import cold_starts
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.fit import fit
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.estimates import (
    estimate_constants,
    FittedConstants,
    join_names,
    OTHER_WARNINGS,
)
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.estimator.state import ACCEL, CONSTANTS, GYRO, IMPERFECTIONS, M, YAW
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
smoother = import_module('odocal_ros.estimator.smoother')
BOTH = 'scale_factor', 'yaw_mounting_angle'
SHORT = {'duration': 200.0, 'imu_grade': 'industrial'}


def result(**options):
    return smoothed(**(SHORT | options))


@pytest.mark.parametrize('options', [
    {}, {'fix_noise': 'rtk'}, {'seed': 2, 'slope': np.deg2rad(4.0)},
    {'antenna_lever_arm': (0.5, -0.3, 1.2), 'imu_lever_arm': (1.0, 0.2, 0.3),
     'odometer_lever_arm': (0.0, 0.8, -0.3)},
    {'outliers': 0.02, 'outlier_size': 30.0}, {'odometer_delay': 0.05},
    {'odometer': 'speed', 'speed_noise': 0.05}, {'sway': 0.05}, {'start_slip': 0.005}], ids=str)
def test_scale_and_yaw_are_within_their_sigmas(options):
    drive, method = result(**options)
    assert method.verdict is not Verdict.REJECTED
    # 3.3 sigmas: one in a thousand; seeds are fixed
    assert off(method, drive, *BOTH) < 3.3
    assert method.estimates['scale_factor'].sigma / drive.truth.scale < 3e-4
    assert method.estimates['yaw_mounting_angle'].sigma < np.deg2rad(0.02)
    late, delay = options.get('odometer_delay', 0.0), method.estimates['odometer_delay']
    assert not late or delay.value == pytest.approx(late, abs=4 * delay.sigma)
    assert not late or delay.sigma < 0.005


@pytest.mark.parametrize('share', [0.0, 0.1])
def test_outliers_among_the_fixes_are_reported(share):
    found = reason_texts(result(outliers=share, outlier_size=30.0)[1]).get(Code.FIX_OUTLIERS, '')
    assert bool(found) == bool(share)
    if share:
        count, of, per_cent, metres = map(float, re.fullmatch(
            r'(\d+) of (\d+) fixes \((\d+) %\) are outliers, up to ([\d.]+) m from the track; '
            'they were down-weighted', found).groups())
        assert per_cent == round(100 * count / of)
        assert count == pytest.approx(share * of, abs=4 * np.sqrt(share * of))      # 4 sigma
        assert metres == pytest.approx(1.5 * 30.0, rel=0.1)       # the largest of many draws


@pytest.mark.parametrize('start', ['scale', 'nothing stands', 'in motion'])
def test_initial_values_have_no_effect(start):
    _, config, leg = made(**SHORT)
    if start == 'scale':
        a, other = result()[1], replace(leg, rough_scale=1.3 * leg.rough_scale)
    else:
        # the same samples, with and without information on standstills; the sigmas differ by it
        same = replace(leg, t_begin=25.0 if start == 'in motion' else leg.t_begin,
                       standstills=np.empty((0, 2)))
        a, other = smooth(same, config), replace(same, rough_scale=0.7 * leg.rough_scale)
    b = smooth(other, config)
    for name in ('scale_factor', *ANGLES):
        one, two = a.estimates[name], b.estimates[name]
        assert abs(one.value - two.value) < 0.1 * one.sigma, name


@pytest.mark.parametrize('yaw_deg', [40.0, -135.0])
def test_large_mounting_angle_needs_no_initial_value(yaw_deg):
    drive, method = result(yaw=np.deg2rad(yaw_deg))
    assert off(method, drive, *BOTH) < 3.3
    _, near = result()
    assert method.estimates['yaw_mounting_angle'].sigma == pytest.approx(
        near.estimates['yaw_mounting_angle'].sigma, rel=0.1)
    assert Code.YAW_FAR_FROM_NOMINAL in reason_texts(method) or abs(yaw_deg) > 90


def test_stated_sigma_equals_the_bound_at_the_truth_and_the_sum_of_its_sources():
    drive, config, leg = made(**SHORT)
    _, method = result()
    details = method.details
    usual = np.array([details[name]['sigma'] / details['posterior_to_prior'][name]
                      for name in CONSTANTS[IMPERFECTIONS]])
    problem = make_problem(leg, config)
    problem.priors.sigma[IMPERFECTIONS] = usual
    equations = Equations(problem, truth(drive, config, leg), fitted=True)
    levels = Levels.from_sigmas(details['noise'])
    covariance = WeightedEquations(equations, levels).solve().covariance
    sigma = np.sqrt(np.diag(covariance))
    scale = method.estimates['scale_factor']
    # linearised at the estimate or at the truth: the same except for heavy tails
    stated = [scale.sigma / scale.value, method.estimates['yaw_mounting_angle'].sigma]
    assert stated == pytest.approx(sigma[:2], rel=0.03)
    total = np.sqrt(np.diag(total_covariance(method.sources)))
    assert stated == pytest.approx(total[:2], rel=1e-3)


def test_uncertainty_increased_by_model_errors_is_explained():
    sigma = np.full(M, np.deg2rad(0.4))
    sigma[0] = 1e-4
    for uncertainty, text in ((1.0, ''),
                              (2.0, '0.80 deg, including a factor of 2 for model errors; the '
                               'limit is 0.5 deg. ')):
        _, reasons = estimate_constants(
            FittedConstants(np.zeros(M), sigma, np.zeros(M), uncertainty), '1', 1.0, Config())
        texts = [r.text for r in reasons if r.code is Code.YAW_NOT_DETERMINED]
        assert len(texts) == bool(text)
        # twice 0.4 deg exceeds the limit, 0.4 deg does not: motion is sufficient
        assert all(text in one and 'the model errors' in one for one in texts)
        assert not text or {r.remedy for r in reasons if r.code in (
            Code.YAW_NOT_DETERMINED, Code.PITCH_NOT_DETERMINED)} == {OTHER_WARNINGS}


def test_straight_drive_at_constant_speed_does_not_determine_the_yaw():
    drive, config, leg = made(scenario='straight', duration=300.0, imu_grade='industrial')
    middle = replace(leg, t_begin=40.0, t_stop=145.0, standstills=np.empty((0, 2)))
    method = smooth(middle, config)
    assert method.estimates['yaw_mounting_angle'].value is None
    reported, expected = map(float, re.findall(r'([\d.]+) deg',
                                               reason_texts(method)[Code.YAW_NOT_DETERMINED]))
    assert reported >= expected > 0.0
    assert off(method, drive) < 3.3


def test_imu_without_configured_or_visible_noise_is_not_perfect():
    drive, config, leg = made(**SHORT)
    zero = with_settings(config, {f'imu.{name}': 0.0 for name in (
        'gyro_noise', 'gyro_bias', 'gyro_bias_walk', 'accel_noise', 'accel_bias',
        'accel_bias_walk', 'gyro_scale_sigma')})
    method = smooth(leg, zero)
    assert Code.IMU_WORSE_THAN_GRADE in reason_texts(method)
    assert off(method, drive, *BOTH) < 3.3
    drive, config, leg = made(**SHORT)
    w_b, f_b = leg.w_b.copy(), leg.f_b.copy()
    for begin, end in leg.standstills:      # as with a dead band, or in a simulator
        rest = (leg.t_imu >= begin) & (leg.t_imu <= end)
        w_b[rest], f_b[rest] = 0.0, f_b[rest].mean(axis=0)
    method = smooth(replace(leg, w_b=w_b, f_b=f_b), config)
    assert off(method, drive, *BOTH) < 3.3


def test_gyro_scale_has_the_configured_sigma():
    _, config, leg = made(**SHORT)
    for required, prior in ((np.nan, 3e-3), (0.02, 0.02), (0.0, 1e-12)):
        asking = with_settings(config, {'imu.gyro_scale_sigma': required})
        assert make_problem(leg, asking).priors.sigma[GYRO.start] == prior


def test_imu_worse_than_its_grade_is_reported():
    drive, config, _ = made(**SHORT)
    rng = np.random.default_rng(5)
    shaking = changed(drive.imu, f_i=lambda f: f + 0.1 * rng.standard_normal(f.shape))
    method = smooth(leg_of(replace(drive.leg(), imu=shaking), config), config)
    reason = next(r for r in method.reasons if r.code is Code.IMU_WORSE_THAN_GRADE)
    assert 'gyro' not in reason.text + reason.remedy      # the gyro does not vibrate
    assert off(method, drive, *BOTH) < 3.3


@pytest.mark.parametrize('ratio', [1.0, 1.3, 2.0, 0.5])
def test_positions_of_another_scale_are_a_mismatch(ratio):
    """The accelerometer knows the scale of the track, but not why the fixes differ."""
    _, config, leg = made(duration=300.0, imu_grade='industrial')
    method = smooth(replace(leg, fixes_n=ratio * leg.fixes_n), config)
    found = re.search('the fixes are ([^ ]+) times as far apart',
                      reason_texts(method).get(Code.MODEL_MISMATCH, ''))
    assert bool(found) == (ratio != 1.0)
    assert not found or float(found[1]) == pytest.approx(ratio, rel=0.05)


def test_last_step_of_an_unconverged_fit_widens_the_sigma():
    _, config, leg = made(**SHORT)
    problem = make_problem(leg, config)
    start = cold_starts(leg, problem.imu, problem.priors, 0.0)[0].state
    start.constants[YAW] += 0.1         # far from the solution, with one pass only
    method = make_result(leg, problem, fit(problem, start, problem.initial_levels, 1), config)
    move = float(re.search('after 1 iterations the estimates still changed by ([^ ]+) sigma',
                           reason_texts(method)[Code.MODEL_MISMATCH])[1])
    assert move > 10.0
    assert method.details['widened'] == pytest.approx(4 * move, rel=0.05)      # 2 digits


def test_fit_with_impossible_imu_errors_gives_no_values(monkeypatch):
    """A false minimum: in an out-and-back drive of the zoo the pitch deviated by 12 sigmas."""
    _, config, leg = made(duration=150.0)
    for wrong, refused in ((0.19, False), (0.21, True)):
        c = np.zeros(M)
        c[ACCEL.start + 1] = -wrong
        fit = SimpleNamespace(converged=True, state=SimpleNamespace(constants=c))
        monkeypatch.setattr(smoother, 'best_fit', lambda *_, fit=fit: fit)
        monkeypatch.setattr(smoother, 'make_result', lambda *_: None)
        method = smooth(leg, config)
        assert (method is not None) == refused
    assert method.estimates['scale_factor'].value is None
    reason, = method.reasons
    assert reason.code is Code.NOT_CONVERGED
    assert 'accelerometer scale y of -21 %, impossible for an IMU (limit 20 %)' in reason.text


def test_equations_without_a_solution_report_the_time(monkeypatch):
    _, config, leg = made(duration=100.0)
    normal = WeightedEquations.normal

    def undetermined(weighted):
        out = normal(weighted)
        out.diagonal[40] *= 1e-9
        return out
    monkeypatch.setattr(WeightedEquations, 'normal', undetermined)
    reason, = smooth(leg, config).reasons
    assert reason.code is Code.NOT_CONVERGED
    imu = make_problem(leg, config).imu
    assert (f'do not determine the motion at t = {imu.t_keyframes[40]:.1f} s. Likely cause: '
            in reason.text)


@pytest.mark.parametrize(('times', 'is_reported'), [(30.0, False), (200.0, True)])
def test_turn_on_bias_of_imus_as_sold_is_not_a_worse_grade(times, is_reported):
    drive, config, _ = made(**SHORT)
    config = with_settings(config, {'imu.grade': 'industrial'})
    bias = times * np.radians(20.0) / 3600.0        # rad/s; IMUs as sold: 0.1 deg/s
    turning = changed(drive.imu, w_i=lambda w: w + [0.0, bias, 0.0])
    method = smooth(leg_of(replace(drive.leg(), imu=turning), config), config)
    assert (Code.IMU_WORSE_THAN_GRADE in reason_texts(method)) == is_reported
    assert off(method, drive, *BOTH) < 3.3


def test_parameter_names_in_reasons_are_words():
    arm = [f'antenna_lever_arm_{axis}' for axis in 'xyz']
    assert join_names(arm) == 'the antenna lever arm'
    assert join_names(['odometer_lever_arm_z', 'gnss_delay', *arm]) == (
        'the odometer lever arm (up), the fix delay and the antenna lever arm')
