# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Attitudes of odometry in plain numbers; its start where rows have gaps or a wheel is late."""

from drives import drive
import numpy as np
import pytest
from streams import odometry_of, poses_of, samples_of

from odocal_ros.apply import attitude
from odocal_ros.data.samples import take
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply
from odocal_ros.nav.strapdown import rotation_increments

SECOND = 10**9


@pytest.mark.parametrize('size', [0.0, 1e-300, 1e-12, 1e-8, 1e-3, 1.0, 3.0])
def test_they_agree_to_the_last_digits(size):
    rng = np.random.default_rng(int(-np.log10(size + 1e-301)))
    q, r = rng.standard_normal((2, 4))
    q, r = q / np.linalg.norm(q), r / np.linalg.norm(r)
    phi, a = rng.standard_normal((2, 3)) * [[size], [1.0]]
    np.testing.assert_allclose(attitude.rotation(phi), quat_from_rotvec(phi), atol=1e-15)
    np.testing.assert_allclose(attitude.quaternion_product(q, r), quat_multiply(q, r), atol=1e-15)
    np.testing.assert_allclose(attitude.rotation_matrix(3 * q), matrix_from_quat(q), atol=1e-15)
    np.testing.assert_allclose(attitude.cross(a, phi), np.cross(a, phi), atol=1e-15 * size)
    np.testing.assert_allclose(attitude.rotate_vector(attitude.rotation_matrix(q), a),
                               matrix_from_quat(q) @ a, atol=1e-15)
    np.testing.assert_array_equal(attitude.add_scaled(a, phi, 0.5), a + phi * 0.5)


@pytest.mark.parametrize('uneven', [0.0, 0.3, 0.9])
def test_rotation_increments_are_those_of_the_strapdown(uneven):
    rng = np.random.default_rng(1)
    t = 1000.0 + np.cumsum(0.01 * (1 + uneven * rng.uniform(-1, 1, 200)))
    w = np.cumsum(rng.standard_normal((200, 3)), axis=0)
    increments = [attitude.rotation_increment(t.tolist(), w.tolist(), k) for k in range(199)]
    # both do the same sums in the same order
    np.testing.assert_array_equal(np.transpose(increments), rotation_increments(t, w))


@pytest.mark.core
@pytest.mark.parametrize('from_s', [1.0, 4.0, 6.0, 9.0])
def test_it_does_not_start_across_a_gap_of_the_imu(from_s):
    made = drive(scenario='town', duration=135.0, imu_grade='industrial')     # 20 s at rest first
    blocks = samples_of(made)
    t = (blocks['imu'].stamp_ns - made.imu.stamp_ns[0]) / SECOND
    blocks['imu'] = take(blocks['imu'], (t < 5.0) | (t > 10.0))
    begins = blocks['odometer'].stamp_ns > made.imu.stamp_ns[0] + int(from_s * SECOND)
    blocks['odometer'] = take(blocks['odometer'], begins)
    odometry, end_ns = odometry_of(made), made.imu.stamp_ns[0] + 20 * SECOND
    poses = poses_of(odometry, {slot: take(block, block.stamp_ns < end_ns)
                                for slot, block in blocks.items()}, made.form)
    assert odometry.restarts == 0
    since = (poses[0].stamp_ns - made.imu.stamp_ns[0]) / SECOND
    # two seconds of rows without a gap
    assert since == pytest.approx(3.1 if from_s < 3.0 else 12.1, abs=0.15)
    assert all(pose.is_valid() for pose in poses)
