# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""IMU steps, their sums and the odometer filter, compared with closed forms."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.odometer import as_rolled, STENCIL_REACH
from odocal_ros.estimator.imu import ImuSteps, STEP
from odocal_ros.estimator.preintegrate import preintegrate
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import exp_so3, skew

RATE = np.array([0.05, -0.1, 0.6])      # rad/s
FORCE = np.array([1.5, -0.7, 9.8])      # m/s^2
BIAS, FORCE_BIAS = np.array([0.01, -0.02, 0.015]), np.array([0.1, 0.05, -0.2])
SPEED = 7.0


def samples(t, w_b, f_b):
    return SimpleNamespace(t_imu=t, w_b=w_b, f_b=f_b, t_begin=t[0], t_stop=t[-1])


def turning(t):
    """Return the samples of a constant turn with a constant force in b, with biases."""
    one = np.ones((len(t), 1))
    return samples(t, one * (RATE + BIAS), one * (FORCE + FORCE_BIAS))


def integrals(T, terms=12):
    """Return the attitude after T, its integral and its double integral, by their series."""
    R, A, AA, power = np.eye(3), np.eye(3) * T, np.eye(3) * T**2 / 2, np.eye(3)
    factorial = 1.0
    for n in range(1, terms):
        power, factorial = power @ skew(RATE), factorial * n
        R = R + power * T**n / factorial
        A = A + power * T**(n + 1) / factorial / (n + 1)
        AA = AA + power * T**(n + 2) / factorial / (n + 1) / (n + 2)
    return R, A, AA


def summed(leg, t_points=(), constants=None):
    imu = ImuSteps.from_leg(leg, 1.0)
    K = len(imu.keyframes) - 1
    return imu, *preintegrate(imu, np.tile(BIAS, (K, 1)), np.tile(FORCE_BIAS, (K, 1)),
                              lambda t: SPEED * t, np.array([1.0, 0.0, 0.0]),
                              np.array(t_points), constants)


@pytest.mark.parametrize('rate', [10.0, 47.0, 200.0])
def test_constant_turn_equals_its_closed_form(rate):
    imu, sums, points = summed(turning(np.arange(0.0, 5.001, 1 / rate)), [1.23, 3.91])
    # G lacks the third power of a step's turn: 0.06^3 / 24 of 7 m and 10 m/s
    loose = (0.61 * max(STEP, 1 / rate))**3 / 24 * 10
    for k, T in enumerate(sums.T):
        R, A, AA = integrals(T)
        np.testing.assert_allclose(sums.R[k], R, atol=BENT)
        np.testing.assert_allclose(sums.dv[k], A @ FORCE, atol=loose + 2 * SECOND / rate**2)
        np.testing.assert_allclose(sums.dp[k], AA @ FORCE, atol=loose + 2 * SECOND / rate**2)
        np.testing.assert_allclose(sums.S[k], SPEED * A, atol=loose)
        np.testing.assert_allclose((sums.A[k], sums.AA[k]), (A, AA), atol=loose)
    for k, tau, dv, dp, R in zip(points.interval, points.tau, points.dv, points.dp, points.R,
                                 strict=True):
        assert imu.t_keyframes[k] + tau == pytest.approx((1.23, 3.91)[int(k > 1)])
        want = integrals(tau)
        np.testing.assert_allclose(R, want[0], atol=BENT)
        # the force is linear within a step; its curvature is 0.6^2 T^2 / 12 of it
        tolerance = loose + 4 * SECOND * max(STEP, 1 / rate)**2
        np.testing.assert_allclose(dv, want[1] @ FORCE, atol=tolerance)
        np.testing.assert_allclose(dp, want[2] @ FORCE, atol=tolerance)


def test_scales_and_axes_multiply_the_signal_and_not_the_bias():
    """Otherwise a scale error of 1 explains bias drift, and the random walk becomes small."""
    t, constants = np.arange(0.0, 5.001, 0.01), np.zeros(layout.M)
    by_rate = np.array(layout.GYRO_SIGNAL) < 3     # not multiplied by the force, which has a bias
    constants[layout.GYRO], constants[layout.ACCEL] = 0.2 * by_rate, 0.1
    one = np.ones((len(t), 1))
    _, sums, points = summed(samples(t, one * BIAS, one * FORCE_BIAS), [1.23, 3.91], constants)
    # second order in the turn by the bias within a step
    tolerance = (np.linalg.norm(BIAS) * STEP)**2 * np.linalg.norm(FORCE_BIAS)
    for found in (sums, points):
        np.testing.assert_allclose(found.R - np.eye(3), 0.0, atol=1e-12)
        for zero in (found.F, found.R_by_gyro[:, :, 3:][:, :, by_rate]):
            np.testing.assert_allclose(zero, 0.0, atol=1e-12)
        for zero in (found.dv, found.dp):
            np.testing.assert_allclose(zero, 0.0, atol=tolerance)
    # an error of the bias is also an error of the signal
    by_bias = np.eye(3, 6)
    by_bias[layout.GYRO_AXIS, layout.GYRO_SIGNAL] -= 0.2 * by_rate
    np.testing.assert_allclose(sums.R_by_gyro[0, :, :3], by_bias[:, :3], atol=1e-9)


# rad: second order in the turn by the bias, ten steps of 0.0027 rad, beside 0.062 rad
BENT = 10 * 0.0027**2 * 0.062 / 12
# m/s: trapezoid rule between samples, times the sample interval squared: w^2 f / 12
SECOND = 0.62**2 * 10.0 / 12


def test_scatter_of_the_angles_of_a_constant_turn_equals_its_closed_form():
    imu = ImuSteps.from_leg(turning(np.arange(0.0, 5.001, 0.01)), 1.0)
    turn = RATE + BIAS
    # an angle that increases linearly over 1 s, as means of steps: 1 / 12 less STEP^2 / 12
    want = np.outer(turn, turn) * (1 - STEP**2) / 12
    np.testing.assert_allclose(imu.angle_covariances(), np.tile(want, (5, 1, 1)), atol=1e-12)


def test_steps_include_coning_at_the_sample_rate():
    rate, cone, spin = 200.0, 0.02, 2 * np.pi * 8.0
    t = np.arange(0.0, 4.001, 1 / rate)

    def attitude(t):
        return Rotation.from_rotvec(cone * np.stack(
            [np.cos(spin * t), np.sin(spin * t), 0 * t], -1))
    d = 1e-5
    w_b = (attitude(t - d).inv() * attitude(t + d)).as_rotvec() / (2 * d)
    imu = ImuSteps.from_leg(samples(t, w_b, np.zeros((len(t), 3))), 1.0)
    R = np.eye(3)
    for turn in imu.turn:
        R = R @ exp_so3(turn)
    want = (attitude(t[:1]).inv() * attitude(t[-1:])).as_matrix()[0]
    # the mean rate alone, 0.01 rad/s about z, gives an error of 0.04 rad
    np.testing.assert_allclose(R, want, atol=2e-4)
    assert abs(imu.signals[:, 2].sum()) == pytest.approx(4 * spin * cone**2 / 2, rel=0.02)


def test_steps_last_a_tenth_of_a_second_and_end_at_keyframes_except_in_gaps():
    t = np.arange(0.0, 4.001, 0.01)
    imu = ImuSteps.from_leg(turning(t), 1.0)
    np.testing.assert_allclose(np.diff(imu.t), STEP, atol=1e-9)
    np.testing.assert_allclose(imu.t_keyframes, np.arange(5.0), atol=1e-9)
    np.testing.assert_allclose(imu.longest, 0.01, atol=1e-9)
    imu = ImuSteps.from_leg(turning(t[(t < 1.33) | (t > 1.78)]), 1.0)
    k = int(np.argmax(imu.longest))
    assert imu.longest[k] == pytest.approx(0.46, abs=0.011)
    assert imu.t[k] <= 1.33
    assert imu.t[k + 1] >= 1.78
    assert np.delete(np.diff(imu.t), k).max() < 2 * STEP
    rare = np.arange(0.0, 30.0, 0.25)
    np.testing.assert_array_equal(ImuSteps.from_leg(turning(rare), 1.0).t, rare)


def test_chunks_of_any_size_give_the_same_sums(monkeypatch):
    t = np.arange(0.0, 20.0, 0.01)
    rng = np.random.default_rng(3)
    leg = samples(t, 0.2 * rng.standard_normal((len(t), 3)), rng.standard_normal((len(t), 3)))
    whole = ImuSteps.from_leg(leg, 1.0)
    monkeypatch.setattr('odocal_ros.estimator.imu.SAMPLES_IN_CACHE', 33)
    monkeypatch.setattr('odocal_ros.estimator.imu.KEYFRAMES_IN_CACHE', 3)
    parts = ImuSteps.from_leg(leg, 1.0)
    for name in ('turn', 'turn_mean', 'dv', 'dp', 'signals', 'longest', 't', 'keyframes'):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), atol=1e-12)


CRUISE, SWING, BEAT = 10.0, 5.0, 0.5     # m/s, m, rad/s: travel CRUISE t + SWING sin(BEAT t)
T = 0.4                                 # s
FINE = np.arange(-5.0, 65.0, 1e-3)
AT = np.arange(0.0, 60.0, 0.1)
ANGLE = BEAT * T
# of derivatives by differences over STENCIL_REACH, and of the next orders of the filters below
ROUNDING = SWING * (ANGLE**2 * (BEAT * STENCIL_REACH)**2 * (1 / 24 + ANGLE / 48)
                    + 0.175 * ANGLE**4 + 0.5 * ANGLE**5)


def travel(t, answer=1.0, delay=0.0):
    """Return travel at t behind a filter with complex gain answer at BEAT and mean delay, s."""
    return CRUISE * (t - delay) + SWING * np.imag(answer * np.exp(1j * BEAT * t))


def rolled(readings, delay, square):
    constants = np.zeros(layout.M)
    constants[layout.ODO_DELAY], constants[layout.ODO_LAG2] = delay, square
    return as_rolled(Travel(FINE, readings, 0.0), constants)(AT)


def test_first_order_filter_and_moving_mean_are_corrected():
    readings = travel(FINE, 1 / (1 + 1j * ANGLE), T)
    np.testing.assert_allclose(rolled(readings, T, T**2), travel(AT), atol=ROUNDING)
    assert 0.1 * np.abs(rolled(readings, T, 0.0) - travel(AT)).max() > ROUNDING
    # A mean over W has variance W^2 / 12 and no third moment; the filter has 2 T^3
    W = np.sqrt(12) * T
    answer = np.exp(-0.5j * BEAT * W) * np.sinc(BEAT * W / 2 / np.pi)
    found = rolled(travel(FINE, answer, W / 2), W / 2, T**2)
    assert np.abs(found - travel(AT)).max() == pytest.approx(SWING * ANGLE**3 / 3, abs=ROUNDING)


@pytest.mark.parametrize('square', [T**2, 0.0, -T**2])
def test_derivative_by_the_squared_lag_is_half_the_acceleration(square):
    """It includes half of T times the change of acceleration, which the fit neglects."""
    h = 1e-4
    found = (rolled(travel(FINE), T, square + h) - rolled(travel(FINE), T, square - h)) / (2 * h)
    lag, angle = np.sqrt(max(square, 0.0)), BEAT * (AT + T)
    expected = SWING * BEAT**2 * (np.sin(angle) - BEAT * lag * np.cos(angle)) / 2
    # differences over STENCIL_REACH; near zero the third moment is that of T^2 = h
    loose = SWING * BEAT**4 * STENCIL_REACH**2 * (1 / 24 + BEAT * lag / 32) \
        + SWING * BEAT**3 * np.sqrt(h)
    np.testing.assert_allclose(found, expected, atol=loose)


def test_drive_that_ends_in_motion_has_the_acceleration_of_its_last_second():
    """A drive that starts in motion has that of its first second; no readings exist beyond."""
    push = 2.0                                  # m/s^2
    constants = np.zeros(layout.M)
    constants[layout.ODO_LAG2] = T**2
    readings = Travel(AT, push * AT**2 / 2, 0.0)
    expected = push * (AT**2 - T**2) / 2
    np.testing.assert_allclose(as_rolled(readings, constants)(AT), expected, atol=1e-9)


def test_fast_clock_is_corrected():
    """The delay is defined at t = 0, where the clocks differ only by it."""
    fast, constants = 1e-3, np.zeros(layout.M)
    constants[layout.ODO_DELAY], constants[layout.ODO_CLOCK] = T, fast
    readings = Travel(FINE * (1 + fast) + T, travel(FINE), 0.0)
    # readings are interpolated linearly between samples
    loose = SWING * BEAT**2 * (FINE[1] - FINE[0])**2 / 8 + 1e-9
    np.testing.assert_allclose(as_rolled(readings, constants)(AT), travel(AT), atol=loose)
