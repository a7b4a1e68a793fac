# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two frames of an IMU: closed forms, and instruments that nothing can tell apart."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.rotations import matrix_from_rpy, rpy_from_matrix
from odocal_ros.sim.housing import angles, own_angles, turn_and_push
from odocal_ros.sim.noise import stream
from odocal_ros.sim.real import Real
from odocal_ros.sim.scenarios import SimOptions, simulate


def cross(x, y, z):
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def test_forward_tells_the_angles_of_the_conventions():
    yaw, pitch = 0.3, -0.2
    assert angles(matrix_from_rpy([0, pitch, yaw])[0]) == pytest.approx((yaw, pitch), abs=1e-15)


@pytest.mark.parametrize('seed', range(5))
def test_in_the_own_frame_turn_and_push_are_felt_as_said(seed):
    gyro, accel = stream(seed, 'test').normal(0, 0.02, (2, 3, 3))
    R = turn_and_push(gyro, accel)
    assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1)
    turned, pushed = (np.eye(3) + gyro) @ R, (np.eye(3) + accel) @ R
    assert_allclose([turned[0, 2], turned[1, 2], pushed[1, 0]], 0, atol=1e-15)
    # to first order; products of two entries are left out, five sigma each
    theta = gyro[1, 2], -gyro[0, 2], -accel[1, 0]
    assert_allclose(R, np.eye(3) + cross(*theta), atol=3 * (5 * 0.02)**2)


def test_angles_of_a_turned_mounting_are_those_of_its_matrices_in_b():
    rng = stream(1, 'test')
    gyro, accel = rng.normal(0, 1e-4, (2, 3, 3))
    C_bi, C_vb = matrix_from_rpy([0.0, 0.0, np.pi / 2]), matrix_from_rpy([0.0, 0.01, 0.03])
    g, a = (C_bi @ M @ C_bi.T for M in (gyro, accel))
    d = C_vb[0] - np.cross([g[1, 2], -g[0, 2], -a[1, 0]], C_vb[0])
    yaw, pitch, yaw_housing, pitch_housing = own_angles(C_vb, C_bi, gyro, accel)
    # second order: two entries of five sigma, 5e-4 each
    assert (yaw, pitch) == pytest.approx((-np.arcsin(d[1]), np.arctan2(d[2], d[0])), abs=1e-6)
    assert (yaw_housing, pitch_housing) == pytest.approx((0.03, 0.01), abs=1e-15)


def test_an_instrument_turned_in_its_housing_is_one_mounted_so():
    theta = np.array([0.6e-3, -1.0e-3, 0.8e-3])
    M, C_bi = cross(*theta), matrix_from_rpy([0.1, 0.2, 0.4])
    flat = tuple((C_bi.T @ M @ C_bi).ravel())
    mounted = {'scenario': 'town', 'duration': 200.0, 'imu_grade': 'perfect', 'imu_rate': 20.0,
               'mounting_rpy': (0.1, 0.2, 0.4), 'imu_lever_arm': (0.5, 0.2, 0.3)}
    turned = simulate(SimOptions(**mounted, yaw=0.03, pitch=0.01,
                                 real=Real(gyro_matrix=flat, accel_matrix=flat)))
    C_vb = matrix_from_rpy([0.0, 0.01, 0.03]) @ (np.eye(3) - M)
    roll, pitch, yaw = rpy_from_matrix(C_vb)
    ideal = simulate(SimOptions(**mounted, roll=roll, pitch=pitch, yaw=yaw))
    size = theta @ theta      # second order
    f, w = (np.abs(getattr(ideal.imu, name)).max() for name in ('f_i', 'w_i'))
    assert_allclose(turned.imu.f_i, ideal.imu.f_i, atol=3 * size * f)
    assert_allclose(turned.imu.w_i, ideal.imu.w_i, atol=3 * size * w)
    assert_allclose([turned.truth.yaw, turned.truth.pitch],
                    [ideal.truth.yaw, ideal.truth.pitch], atol=3 * size)
    # and the first order is there to be seen
    assert turned.truth.yaw - 0.03 == pytest.approx(-0.8e-3, abs=0.1e-3)
    assert turned.truth.pitch - 0.01 == pytest.approx(1.0e-3, abs=0.1e-3)
    assert (turned.truth.yaw_housing, turned.truth.pitch_housing) == pytest.approx((0.03, 0.01))
