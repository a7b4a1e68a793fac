# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The cause of IMU noise is named by evidence; twist noise agrees with simulated drives."""

from types import SimpleNamespace

from drives import drive, settings
import numpy as np
import pytest

from odocal_ros.calib.result import RAW_SCALE
from odocal_ros.estimator.factors.factor import ACCEL_NOISE, VARIANCE_FACTOR_COUNT
from odocal_ros.estimator.result import mismatch
from odocal_ros.estimator.result.mismatch import find_noise_cause, find_quantisation_steps
from odocal_ros.estimator.result.odometry_output import twist_noise
from odocal_ros.estimator.several import _disagreement_reasons
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.combination import combine
from odocal_ros.sim.real_effects import RealEffects

RATE = 100.0


def leg(step_w, step_f, noise=0.5, n=20_000):
    rng = np.random.default_rng(3)
    w, f = (np.cumsum(rng.standard_normal((n, 3)), axis=0) * 1e-3 + noise * 0.05
            * rng.standard_normal((n, 3)) for _ in range(2))
    w, f = (np.round(x / q) * q if q else x for x, q in ((w, step_w), (f, step_f)))
    return SimpleNamespace(t_imu=np.arange(n) / RATE, w_b=w, f_b=f)


def test_quantisation_step_is_found_and_explains_only_noise_of_its_size():
    without_noise = {'gyro': 0.0, 'accel': 0.0}       # any step explains zero noise
    assert find_quantisation_steps(leg(np.deg2rad(0.25), 0.0), without_noise) == {
        'gyro': pytest.approx(np.deg2rad(0.25), rel=0.01)}
    step = 0.125
    white = step * np.sqrt(1 / 12 / RATE)        # closed form of rounding
    coarse = leg(0.0, step)
    assert find_quantisation_steps(coarse, {'gyro': 1.0, 'accel': 1.4 * white}) == {
        'accel': pytest.approx(step, rel=0.01)}
    assert find_quantisation_steps(coarse, {'gyro': 1.0, 'accel': 2.0 * white}) == {}


def problem(leg, rest):
    """Return the input of the cause search; rest: s of standstill before the drive."""
    keys = np.arange(0.0, leg.t_imu[-1], 1.0)
    return SimpleNamespace(leg=leg, at_rest=keys < rest, imu=SimpleNamespace(t_keyframes=keys))


def noisy(moving, rest, rest_s=60.0, n=20_000):
    """Return a leg with white noise, rad/s/sqrt(Hz), in motion and at rest."""
    one = leg(0.0, 0.0, noise=0.0, n=n)
    sigma = np.where(one.t_imu < rest_s, rest, moving)[:, None] * np.sqrt(RATE)
    rng = np.random.default_rng(4)
    one.w_b = sigma * rng.standard_normal((n, 3))
    return problem(one, rest_s)


def test_noise_only_in_motion_is_vibration_and_noise_at_rest_is_the_sensor():
    for moving, rest, gyro, cause, other in (
            (1e-2, 1e-3, 5e-3, 'vibration: gyro samples vary 10 times as much in motion as at '
             'rest', 'imu.gyro_noise'),
            (1e-2, 8e-3, 1e-2, 'If this is normal for this gyro, set imu.gyro_noise to 0.01 '
             '(rad/s/sqrt(Hz)).', 'cause is vibration'),
            (1e-3, 1e-3, 1e-2, 'unknown: single samples vary less', 'at rest it is similar')):
        text = find_noise_cause(noisy(moving, rest), {'gyro': gyro, 'accel': 1.0}, ['gyro'])
        assert cause in text
        assert other not in text


def test_cause_of_one_sensor_is_not_stated_for_both():
    one = noisy(1e-2, 1e-2)
    sigma = np.where(one.leg.t_imu < 60.0, 0.01, 0.1)[:, None]
    one.leg.f_b = sigma * np.random.default_rng(5).standard_normal((len(sigma), 3))
    text = find_noise_cause(one, {'gyro': 1e-2, 'accel': 5e-3}, ['gyro', 'accel'])
    assert text.startswith('The cause of the accelerometer noise is vibration: ')
    assert 'The gyro noise does not come from vibration: at rest it is similar.' in text
    text = find_noise_cause(one, {'gyro': 1e-2, 'accel': 5e-3}, ['accel'])
    assert text.startswith('The cause is vibration: ')


def test_unexplained_noise_without_a_standstill_is_vibration_or_unknown():
    one = noisy(1e-2, 1e-2, rest_s=0.0)
    vibrating = find_noise_cause(one, {'gyro': 1e-3, 'accel': 1.0}, ['gyro'])
    assert 'gyro samples vary 10 times as much as their means over seconds' in vibrating
    assert 'unknown: there is no standstill' in find_noise_cause(
        one, {'gyro': 1e-2, 'accel': 1.0}, ['gyro'])


def test_quantised_sensor_is_named_beside_another_cause():
    one = noisy(1e-2, 8e-3)
    one.leg.f_b = np.round(np.cumsum(np.full((20_000, 3), 1e-3), axis=0) / 0.125) * 0.125
    white = 0.125 * np.sqrt(1 / 12 / RATE)
    text = find_noise_cause(one, {'gyro': 1e-2, 'accel': white}, ['gyro', 'accel'])
    assert 'quantisation: the accelerometer has steps of 0.125 m/s^2' in text
    assert 'gyro noise does not come from vibration' in text
    assert find_noise_cause(one, {'gyro': 1e-2, 'accel': white}, []) == ''


@pytest.mark.parametrize(('seconds', 'reported'), [(1, False), (2, False), (3, True)])
def test_shock_in_a_short_drive_is_not_vibration(seconds, reported):
    spread = np.ones((60, VARIANCE_FACTOR_COUNT))
    spread[:seconds, ACCEL_NOISE] = 100.0
    fit = SimpleNamespace(variance_factors=spread, levels={'accel': 0.005**2})
    assert bool(mismatch._accelerometer_outlier_reasons(fit)) == reported


@pytest.mark.parametrize(('name', 'tyres'), [('odometer_delay', False), ('scale_factor', True)])
def test_legs_that_differ_in_a_delay_are_not_attributed_to_a_tyre(name, tyres):
    found = SimpleNamespace(deviation=np.array([[9.0], [-9.0]]), names=[name], differing=[name],
                            factor=1.0)
    reason, = _disagreement_reasons(found, [1, 2])
    assert ('tyre' in reason.remedy) == tyres
    assert ('time stamps' in reason.remedy) != tyres


def errors_over_sigma(made):
    """Return rms error over sigma of the speed, and of the turn rate with two wheels."""
    config = settings(made, heading_sigma=None, method='smoother')
    result = combine([calibrate(made.leg(), config)], config)
    noise, estimates = twist_noise(result), result.estimates
    t = (made.odometer.stamp_ns - made.options.start_ns) * 1e-9
    state, T = made.motion.at(t), np.diff(t)
    if made.options.odometer == 'speed':        # instantaneous
        factor = estimates.get(RAW_SCALE, estimates['scale_factor']).value
        v, w, wheels = state.speed[1:], state.yaw_rate[1:], [factor * made.odometer.value[1:]]
    else:                                       # mean between two messages
        sides = ('_left', '_right') if len(made.wheels) > 1 else ('',)
        v, w = np.diff(state.travel) / T, (state.yaw_rate[1:] + state.yaw_rate[:-1]) / 2
        wheels = [estimates[f'scale_factor{side}'].value * np.diff(wheel.value) / T
                  for side, wheel in zip(sides, made.wheels, strict=True)]
    moving = np.abs(v) > 0.5
    variance = np.array([noise.variances(*row) for row in zip(v[moving], w[moving], strict=True)])
    found = [(np.mean(wheels, axis=0) - v)[moving]**2 / variance[:, 0]]
    if noise.has_turn_rate:
        turned = (wheels[1] - wheels[0]) / estimates['track_width'].value
        found.append((turned - w)[moving]**2 / variance[:, 3])
    return np.sqrt(np.mean(found, axis=1))


@pytest.mark.slow
@pytest.mark.parametrize('options', [
    {}, {'two_wheels': True, 'slip_walk': 0.01},
    {'two_wheels': True, 'odometer_rate': 50.0, 'scenario': 'yard', 'fix_noise': 'rtk'},
    {'odometer': 'angle', 'slip_walk': 0.01, 'odometer_rate': 20.0},
    {'odometer': 'speed', 'speed_noise': 0.02},
    {'odometer': 'speed', 'seed': 12, 'real': RealEffects(speed_step=1 / 3.6), 'duration': 500.0},
    {'odometer': 'speed', 'speed_noise': 0.005, 'scenario': 'motorway',
     'real': RealEffects(speed_law=0.01)}], ids=str)
def test_errors_over_sigma_have_rms_one(options):
    """
    With 300 s at 10 Hz or more, the rms of independent errors is within 1.3 % of one.

    The tolerance allows dependent errors: constants, one constant quantised speed.
    """
    made = drive(**({'scenario': 'town', 'duration': 300.0, 'seed': 4, 'imu_grade': 'industrial',
                     'odometer_rate': 10.0} | options))
    for ratio in errors_over_sigma(made):
        assert 0.85 < ratio < 1.15
