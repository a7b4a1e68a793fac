# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The cause of an IMU noise is named by its evidence; a delay that differs is no tyre."""

from types import SimpleNamespace

import numpy as np
import pytest

from odocal_ros.estimator.result.noise_cause import noise_remedy, quantised, steps
from odocal_ros.estimator.several import _disputed

RATE = 100.0


def leg(step_w, step_f, noise=0.5, n=20_000):
    rng = np.random.default_rng(3)
    w, f = (np.cumsum(rng.standard_normal((n, 3)), axis=0) * 1e-3 + noise * 0.05
            * rng.standard_normal((n, 3)) for _ in range(2))
    w, f = (np.round(x / q) * q if q else x for x, q in ((w, step_w), (f, step_f)))
    return SimpleNamespace(t_imu=np.arange(n) / RATE, w_b=w, f_b=f)


def test_the_step_of_a_signal_is_found_and_none_where_there_is_none():
    found = steps(leg(np.deg2rad(0.25), 0.0))
    assert found['gyro'] == pytest.approx(np.deg2rad(0.25), rel=0.01)
    assert found['accel'] == 0.0


def test_quantisation_explains_noise_of_its_own_size_only():
    step = 0.125
    white = step * np.sqrt(1 / 12 / RATE)        # the closed form of rounding
    coarse = leg(0.0, step)
    assert quantised(coarse, {'gyro': 1.0, 'accel': 1.4 * white}) == {
        'accel': pytest.approx(step, rel=0.01)}
    assert quantised(coarse, {'gyro': 1.0, 'accel': 2.0 * white}) == {}


def problem(leg, rest):
    """Return what the cause is found by; rest: s of standstill in front."""
    keys = np.arange(0.0, leg.t_imu[-1], 1.0)
    return SimpleNamespace(leg=leg, still=keys < rest,
                           imu=SimpleNamespace(t=keys, key=np.arange(len(keys))))


def noisy(moving, rest, rest_s=60.0, n=20_000):
    """Return a leg whose samples vary so, white as rad/s/sqrt(Hz), in motion and at rest."""
    one = leg(0.0, 0.0, noise=0.0, n=n)
    sigma = np.where(one.t_imu < rest_s, rest, moving)[:, None] * np.sqrt(RATE)
    rng = np.random.default_rng(4)
    one.w_b = sigma * rng.standard_normal((n, 3))
    return problem(one, rest_s)


def test_noise_in_motion_only_is_vibration_noise_at_rest_the_sensors_else_unknown():
    text = noise_remedy(noisy(1e-2, 1e-3), {'gyro': 5e-3, 'accel': 1.0}, ['gyro'])
    assert 'vibration: gyro samples vary 10 times as much in motion as at rest' in text
    assert 'imu.gyro_noise' not in text
    text = noise_remedy(noisy(1e-2, 8e-3), {'gyro': 1e-2, 'accel': 1.0}, ['gyro'])
    assert 'If this is its normal noise, set imu.gyro_noise to 0.01 (rad/s/sqrt(Hz)).' in text
    assert 'cause is vibration' not in text
    text = noise_remedy(noisy(1e-3, 1e-3), {'gyro': 1e-2, 'accel': 1.0}, ['gyro'])
    assert 'unknown: single samples vary less' in text
    assert 'at rest it is similar' not in text


def test_a_cause_of_one_sensor_is_not_stated_for_both():
    one = noisy(1e-2, 1e-2)
    sigma = np.where(one.leg.t_imu < 60.0, 0.01, 0.1)[:, None]
    one.leg.f_b = sigma * np.random.default_rng(5).standard_normal((len(sigma), 3))
    text = noise_remedy(one, {'gyro': 1e-2, 'accel': 5e-3}, ['gyro', 'accel'])
    assert text.startswith('The cause of the accelerometer noise is vibration: ')
    assert 'The gyro noise does not come from vibration: at rest it is similar.' in text
    text = noise_remedy(one, {'gyro': 1e-2, 'accel': 5e-3}, ['accel'])
    assert text.startswith('The cause is vibration: ')


def test_without_a_standstill_noise_that_does_not_add_up_is_vibration_else_unknown():
    one = noisy(1e-2, 1e-2, rest_s=0.0)
    vibrating = noise_remedy(one, {'gyro': 1e-3, 'accel': 1.0}, ['gyro'])
    assert 'gyro samples vary 10 times as much as their means over seconds' in vibrating
    assert 'unknown: there is no standstill' in noise_remedy(
        one, {'gyro': 1e-2, 'accel': 1.0}, ['gyro'])


def test_a_quantised_sensor_is_named_beside_another_cause():
    one = noisy(1e-2, 8e-3)
    one.leg.f_b = np.round(np.cumsum(np.full((20_000, 3), 1e-3), axis=0) / 0.125) * 0.125
    white = 0.125 * np.sqrt(1 / 12 / RATE)
    text = noise_remedy(one, {'gyro': 1e-2, 'accel': white}, ['gyro', 'accel'])
    assert 'quantisation: the accelerometer has steps of 0.125 m/s^2' in text
    assert 'gyro noise does not come from vibration' in text
    assert noise_remedy(one, {'gyro': 1e-2, 'accel': white}, []) == ''


@pytest.mark.parametrize(('name', 'tyres'), [('odometer_delay', False), ('scale_factor', True)])
def test_legs_that_differ_in_a_delay_blame_no_tyre(name, tyres):
    found = SimpleNamespace(deviation=np.array([[9.0], [-9.0]]), names=[name], disputed=[name],
                            factor=1.0)
    reason, = _disputed(found, [1, 2])
    assert ('tyre' in reason.remedy) == tyres
    assert ('time stamps' in reason.remedy) != tyres
