# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles and rotations against series, scipy, mpmath and each other, across wrap-arounds."""


from hypothesis import given, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.rotations import (
    arctan2,
    exp_so3,
    heading_from_yaw,
    matrix_from_quat,
    matrix_from_rpy,
    quat_conjugate,
    quat_from_matrix,
    quat_from_rotvec,
    quat_multiply,
    rotvec_from_quat,
    rpy_from_matrix,
    wrap,
    yaw_from_heading,
    yaw_from_quat,
)

pytestmark = pytest.mark.core
ANGLES = st.floats(-50.0, 50.0)


@pytest.mark.parametrize('turns', range(-4, 5))
@pytest.mark.parametrize('steps', range(-4, 5))
def test_wrap_stays_in_its_interval_beside_every_odd_pi(turns, steps):
    angle = np.float64((2 * turns + 1) * np.pi)
    angle = angle + steps * np.spacing(angle)
    assert -np.pi < wrap(angle) <= np.pi
    assert wrap(np.array([[0.0, angle]])).shape == (1, 2)
    # and a heading below a full turn beside north
    assert 0 <= heading_from_yaw(np.pi / 2 + steps * np.spacing(np.pi / 2)) < 2 * np.pi


@given(angle=ANGLES)
def test_wrap_subtracts_whole_turns_and_keeps_angles_inside(angle):
    turns = (angle - wrap(angle)) / (2 * np.pi)
    # 50 rad carry 7e-15 of round-off, and so does the remainder
    assert turns == pytest.approx(round(turns), abs=1e-14)
    assert wrap(wrap(angle)) == wrap(angle)
    if -np.pi < angle <= np.pi:
        assert wrap(angle) == angle


@pytest.mark.parametrize(('heading_deg', 'east', 'north'), [
    (0, 0, 1), (90, 1, 0), (180, 0, -1), (270, -1, 0)])
def test_heading_turns_clockwise_from_north(heading_deg, east, north):
    yaw = yaw_from_heading(np.deg2rad(heading_deg))
    np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], [east, north], atol=1e-15)


@given(yaw=ANGLES)
def test_heading_and_yaw_are_inverse_functions(yaw):
    heading = heading_from_yaw(yaw)
    assert 0 <= heading < 2 * np.pi
    assert wrap(yaw_from_heading(heading) - yaw) == pytest.approx(0, abs=2e-14)


@pytest.mark.parametrize('function', [
    lambda rows: arctan2(*rows.T[:2]),
    lambda rows: rotvec_from_quat(rows / np.linalg.norm(rows, axis=1)[:, None])])
def test_angles_and_rotation_vectors_do_not_depend_on_memory_layout(function):
    """With numpy 1.26 a tenth of the copies has other last digits in np.arctan2 itself."""
    rng = np.random.default_rng(0)
    rows, held, seen = rng.normal(size=(7001, 4)), [], set()
    for _ in range(200):
        held = [*held[-50:], bytearray(int(rng.integers(60_000)))]      # move what comes after
        seen.add(function(rows.copy()).tobytes())
    assert len(seen) == 1


ROUND_OFF = 2e-15    # a dozen operations on numbers up to 2, an ulp of 2.2e-16 each
AXIS = st.floats(-3.0, 3.0)
VECTORS = st.tuples(AXIS, AXIS, AXIS).map(np.array)


def same_rotation(p, q):
    """Return the angle between two unit quaternions, rad, for either sign of them."""
    d = quat_multiply(quat_conjugate(p), q)
    return 2 * np.arctan2(np.linalg.norm(d[..., :3], axis=-1), np.abs(d[..., 3]))


@pytest.mark.parametrize('x', np.logspace(-12, np.log10(3.1), 40))
def test_exp_and_quaternion_keep_all_digits_from_tiny_to_large(x):
    mp = pytest.importorskip('mpmath')
    with mp.workdps(40):
        sin, versin, half = float(mp.sin(x)), float(1 - mp.cos(x)), float(mp.sin(mp.mpf(x) / 2))
    C = exp_so3([x, 0.0, 0.0])
    assert C[2, 1] == pytest.approx(sin, rel=1e-15)
    # sinc squared: a few roundings, and one of the 1 it is taken from
    assert 1 - C[1, 1] == pytest.approx(versin, rel=2e-15, abs=3e-16)
    assert quat_from_rotvec([x, 0.0, 0.0])[0] == pytest.approx(half, rel=1e-15)


@given(phi=VECTORS, length=st.floats(0.01, 100.0))
def test_matrix_and_quaternion_of_any_length_agree(phi, length):
    q = quat_from_rotvec(phi)
    assert_allclose(matrix_from_quat(q), exp_so3(phi), atol=ROUND_OFF)
    assert_allclose(matrix_from_quat(length * q), matrix_from_quat(q), atol=ROUND_OFF)
    assert_allclose(exp_so3(rotvec_from_quat(q)), exp_so3(phi), atol=2 * ROUND_OFF)


# half-turns about the three axes (w = 0) and none: one for each row quat_from_matrix may take
@pytest.mark.parametrize('turn', [*(np.eye(3) * np.pi), np.zeros(3)])
@given(off=VECTORS)
def test_quaternion_of_a_matrix_on_each_of_its_four_branches(turn, off):
    q = quat_multiply(quat_from_rotvec(turn), quat_from_rotvec(0.2 * off))
    found = quat_from_matrix(matrix_from_quat(q))
    assert found[3] >= 0
    assert np.linalg.norm(found) == pytest.approx(1, abs=ROUND_OFF)
    assert same_rotation(found, q) < 2 * ROUND_OFF


@pytest.mark.parametrize('up', [1, -1])
@pytest.mark.parametrize('off', [0.0, *np.logspace(-16, -1, 31)])
def test_matrix_is_recovered_from_rpy_at_and_near_gimbal_lock(up, off):
    """Roll and yaw are lost there, but together they must still give the same matrix."""
    R = exp_so3([0.4, -1.3, 2.2])
    C = matrix_from_rpy([0.3, up * (np.pi / 2 - off), -1.1]) @ R @ R.T     # with its round-off
    # within 1e-12 of the lock roll is taken as 0
    assert_allclose(matrix_from_rpy(rpy_from_matrix(C)), C, atol=2e-12)
    assert off or rpy_from_matrix(matrix_from_rpy([0.3, np.pi / 2, -1.1]))[0] == 0.0
    if not 1e-15 < off < 1e-11:
        assert_allclose(matrix_from_rpy(rpy_from_matrix(C)), C, atol=ROUND_OFF)


def test_rotations_agree_with_scipy():
    Rotation = pytest.importorskip('scipy.spatial.transform').Rotation
    rng = np.random.default_rng(3)
    theirs = Rotation.from_rotvec(rng.normal(0, 1.5, (200, 3)))
    q = theirs.as_quat()
    assert_allclose(matrix_from_quat(q), theirs.as_matrix(), atol=ROUND_OFF)
    assert same_rotation(quat_from_matrix(theirs.as_matrix()), q).max() < 2 * ROUND_OFF
    assert_allclose(quat_multiply(q[:100], q[100:]), (theirs[:100] * theirs[100:]).as_quat()
                    * np.sign(np.einsum('ij,ij->i', quat_multiply(q[:100], q[100:]),
                                        (theirs[:100] * theirs[100:]).as_quat()))[:, None],
                    atol=ROUND_OFF)
    # their lower-case xyz are fixed axes too; pitch near 90 deg loses digits on both sides
    rpy = rpy_from_matrix(theirs.as_matrix())
    assert_allclose(matrix_from_rpy(theirs.as_euler('xyz')), theirs.as_matrix(), atol=1e-14)
    assert_allclose(rpy[:, 1], theirs.as_euler('xyz')[:, 1], atol=1e-7)


@given(VECTORS)
def test_the_yaw_of_a_quaternion_is_that_of_its_matrix_to_the_last_bit(phi):
    q = 1.7 * quat_from_rotvec(np.array([phi, -2 * phi, [0.1, 0.2, 3.0]]))
    C = matrix_from_quat(q)
    np.testing.assert_array_equal(yaw_from_quat(q), arctan2(C[:, 1, 0], C[:, 0, 0]))
