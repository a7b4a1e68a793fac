# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of a real IMU: axes of both triads, warm-up, vibration, late stamps."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.rotations import matrix_from_rpy, rpy_from_matrix
from odocal_ros.sim import real_sensors
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.options import resolve, SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.real_sensors import sensor_axes
from odocal_ros.sim.scenarios import simulate

pytestmark = pytest.mark.core
STRAIGHT = SimOptions(scenario='straight', duration=200.0, imu_rate=20.0, imu_grade='perfect')
MANY = 40_000


def options(**figures):
    return resolve(replace(STRAIGHT, real=RealEffects(**figures)))


def test_imu_readings_obey_the_error_model():
    rng = make_rng(1, 'test')
    w, f = rng.standard_normal((2, 7, 3))
    gyro, accel, G = rng.normal(0, 0.01, (3, 3, 3))
    w_m, f_m = real_sensors.with_triad_errors(w, f, RealEffects(
        gyro_matrix=tuple(gyro.ravel()), accel_matrix=tuple(accel.ravel()),
        g_sensitivity=tuple(G.ravel())))
    for k in range(7):
        assert_allclose(w_m[k], (np.eye(3) + gyro) @ w[k] + G @ f[k], atol=1e-15)
        assert_allclose(f_m[k], (np.eye(3) + accel) @ f[k], atol=1e-15)


def test_a_given_bias_is_used_and_follows_its_warm_up_curve():
    given = options(gyro_bias=(0.01, -0.02, 0.03), gyro_slope=(1e-4, 0, -2e-4), warm_rise=10.0,
                    warm_time=50.0)
    drive, plain = simulate(given), simulate(STRAIGHT)
    assert drive.truth.gyro_bias == pytest.approx([0.01, -0.02, 0.03])
    more = drive.imu.w_i - plain.imu.w_i
    t = (drive.imu.stamp_ns - given.start_ns) * 1e-9
    warm = 10 * (1 - np.exp(-t / 50))
    assert_allclose(more, [0.01, -0.02, 0.03] + warm[:, None] * [1e-4, 0, -2e-4], atol=1e-15)
    assert (drive.imu.f_i == plain.imu.f_i).all()


def test_bias_instability_starts_at_the_bias_and_is_a_markov_process():
    t = np.arange(0.0, 100.0, 0.05)
    ends = [real_sensors.drift_and_vibration(t, np.zeros(len(t)), replace(options(
        gyro_instability=0.01, instability_time=200.0), seed=seed))[0] for seed in range(300)]
    assert all((one[0] == 0).all() for one in ends)
    # variance of x(T) - x(0): 2 s^2 (1 - exp(-T / tau)); 900 draws, 5 sigma
    last = np.array([one[-1] for one in ends])
    assert last.var() / (2e-4 * -np.expm1(-t[-1] / 200)) == pytest.approx(
        1, rel=5 * np.sqrt(2 / 900))


@pytest.mark.parametrize('rate', [50.0, 200.0])
def test_vibration_has_the_configured_size_and_no_drift(rate):
    x = real_sensors.vibration(make_rng(2, 'test'), 0.5, rate, MANY)
    # resonances 6 Hz wide: some 2 * 6 Hz draws a second
    assert x.var() / 0.25 == pytest.approx(1, rel=5 * np.sqrt(2 / (3 * MANY / rate * 12)))
    power = np.abs(np.fft.rfft(x, axis=0))**2
    f = np.fft.rfftfreq(MANY, 1 / rate)
    # the share of white noise of this size below 1 Hz would be 2 / rate: here (f / 12 Hz)^4 of it
    assert power[f < 1].sum() / power.sum() < 2 / rate * (1 / 12)**4


def test_vibration_comes_with_speed_and_moves_the_bias_by_its_square():
    t, speed = np.arange(MANY) / 20.0, np.full(MANY, 5.0)       # half of it at 5 m/s
    vibrating = options(vibration=0.8, rectification=0.01)
    _, accel = real_sensors.drift_and_vibration(t, speed, vibrating)
    assert accel.mean(axis=0) == pytest.approx(0.01 * 0.4**2, rel=1e-6)
    _, still = real_sensors.drift_and_vibration(t, 0 * speed, vibrating)
    assert (still == 0).all()


def test_a_bias_steps_once_by_its_size():
    t = np.arange(0.0, 20.0, 0.1)
    gyro, accel = real_sensors.drift_and_vibration(t, 0 * t, options(accel_step=(0.1, 0.0, -0.2),
                                                        bias_step_at=7.0))
    assert gyro == 0.0
    assert (accel == np.where(t >= 7.0, [[0.1], [0.0], [-0.2]], 0.0).T).all()


def test_late_stamps_are_in_order_and_in_batches():
    ns = np.arange(MANY) * 10_000_000
    late = (real_sensors.delayed_stamps(ns, make_rng(3, 'test'), 0.02, 0.003) - ns) * 1e-9
    # at this interval stamps rarely cross: mean within 5 sigma, scatter as configured
    assert late.mean() == pytest.approx(0.02, abs=5 * 0.003 / MANY**0.5)
    assert late.std() == pytest.approx(0.003, rel=5 / np.sqrt(2 * MANY))
    wild = real_sensors.delayed_stamps(ns, make_rng(3, 'test'), 0.02, 0.02)
    assert (np.diff(wild) >= real_sensors.MIN_GAP_NS).all()
    assert (wild >= ns).all()
    batch = real_sensors.delayed_stamps(ns, make_rng(3, 'test'), 0.002, 0.0, 4)
    assert set(np.diff(batch).tolist()) == {real_sensors.MIN_GAP_NS,
                                            40_000_000 - 3 * real_sensors.MIN_GAP_NS}
    assert (batch[:4] - ns[3] >= 2_000_000).all()


def test_late_stamps_do_not_move_the_true_marks():
    plain, late = simulate(STRAIGHT), simulate(options(imu_latency=0.07))
    assert late.truth.start_ns - plain.truth.start_ns == 70_000_000
    assert (late.imu.f_i == plain.imu.f_i).all()


@pytest.mark.parametrize(('figures', 'message'), [
    ({'gyro_matrix': (1, 2)}, 'required: 9 numbers'), ({'squat': (1, 2)}, 'required: one number'),
    ({'gyro_bias': 1.0}, 'required: 3 numbers'), ({'vibration': -1}, 'required: 0 or more'),
    ({'speed_rounding': 'up'}, 'required: one of floor, round'), ({'drops': 1.0}, 'below 1'),
    ({'configured_grade': 'best'}, 'required: one of consumer'),
    ({'slow_errors': (1, 60)}, 'required: pairs'),
    ({'slow_errors': ((1, 0),)}, 'required: a correlation time above 0'),
    ({'tunnels': ((200, 0),)}, 'required: a length above 0'),
    ({'warm_time': 0.0}, 'required: above 0'), ({'squat': float('nan')}, 'required: finite'),
    ({'imu_batch': 1.5}, 'a whole number, 1 or more')])
def test_impossible_options_are_refused(figures, message):
    from odocal_ros.errors import BadUsage
    with pytest.raises(BadUsage, match=message):
        RealEffects(**figures)


def cross(x, y, z):
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@pytest.mark.parametrize('seed', range(5))
def test_sensor_axes_are_those_of_measured_turns_and_forces(seed):
    gyro, accel = make_rng(seed, 'test').normal(0, 0.02, (2, 3, 3))
    R = sensor_axes(gyro, accel)
    assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1)
    turned, pushed = (np.eye(3) + gyro) @ R, (np.eye(3) + accel) @ R
    assert_allclose([turned[0, 2], turned[1, 2], pushed[1, 0]], 0, atol=1e-15)
    # to first order; products of two entries are left out, five sigma each
    theta = gyro[1, 2], -gyro[0, 2], -accel[1, 0]
    assert_allclose(R, np.eye(3) + cross(*theta), atol=3 * (5 * 0.02)**2)


def test_a_sensor_rotated_in_its_housing_equals_a_rotated_mounting():
    theta = np.array([0.6e-3, -1.0e-3, 0.8e-3])
    M, C_bi = cross(*theta), matrix_from_rpy([0.1, 0.2, 0.4])
    flat = tuple((C_bi.T @ M @ C_bi).ravel())
    mounted = {'scenario': 'town', 'duration': 200.0, 'imu_grade': 'perfect', 'imu_rate': 20.0,
               'mounting_rpy': (0.1, 0.2, 0.4), 'imu_lever_arm': (0.5, 0.2, 0.3)}
    turned = simulate(SimOptions(**mounted, yaw=0.03, pitch=0.01,
                                 real=RealEffects(gyro_matrix=flat, accel_matrix=flat)))
    C_vb = matrix_from_rpy([0.0, 0.01, 0.03]) @ (np.eye(3) - M)
    roll, pitch, yaw = rpy_from_matrix(C_vb)
    ideal = simulate(SimOptions(**mounted, roll=roll, pitch=pitch, yaw=yaw))
    size = theta @ theta      # second order
    f, w = (np.abs(getattr(ideal.imu, name)).max() for name in ('f_i', 'w_i'))
    assert_allclose(turned.imu.f_i, ideal.imu.f_i, atol=3 * size * f)
    assert_allclose(turned.imu.w_i, ideal.imu.w_i, atol=3 * size * w)
    assert_allclose([turned.truth.yaw, turned.truth.pitch],
                    [ideal.truth.yaw, ideal.truth.pitch], atol=3 * size)
    # and the first order is significant
    assert turned.truth.yaw - 0.03 == pytest.approx(-0.8e-3, abs=0.1e-3)
    assert turned.truth.pitch - 0.01 == pytest.approx(1.0e-3, abs=0.1e-3)
    assert (turned.truth.yaw_housing, turned.truth.pitch_housing) == pytest.approx((0.03, 0.01))
