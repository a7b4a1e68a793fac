# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Levelling, gyrocompass and gyro bias against truth; sigmas against many draws."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.alignment import (
    gyrocompass,
    level_at_rest,
    level_frame,
    make_alignment,
    REST_EDGE,
)
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import earth_rate_n, gravity
from odocal_ros.nav.rotations import matrix_from_rpy, wrap
from odocal_ros.settings.nominal import GRADES

pytestmark = pytest.mark.core
LATITUDE, SECONDS, RATE = 0.7, 60.0, 5.0
RPY = np.array([0.05, -0.08, 2.3])
EXACT = replace(GRADES['navigation'], gyro_bias=1e-3)    # a sigma that rejects no measured bias
DRAWS = 400


def rest(C_nb, latitude=LATITUDE, gyro_bias=0.0, accel_bias=0.0, grade=None, rng=None,
         seconds=SECONDS):
    """Return t, w_b, f_b of an IMU at rest; noise and bias walk of grade drawn from rng."""
    t = np.arange(0.0, seconds + 1e-9, 1 / RATE)
    w = np.tile(C_nb.T @ earth_rate_n(latitude) + gyro_bias, (len(t), 1))
    f = np.tile(C_nb.T @ [0.0, 0.0, gravity(latitude, 0.0)] + accel_bias, (len(t), 1))
    if rng is not None:
        draw = (len(t), 3)
        walk = np.cumsum(rng.normal(size=draw), axis=0) * grade.gyro_bias_walk / np.sqrt(RATE)
        # the reference is the bias of the last row
        w += grade.gyro_noise * np.sqrt(RATE) * rng.normal(size=draw) + walk - walk[-1]
        f += grade.accel_noise * np.sqrt(RATE) * rng.normal(size=draw)
    return t, w, f


def levelled(sensors, grade=EXACT):
    t = sensors[0]
    return level_at_rest(*sensors, (t[0], t[-1]), grade, grade.gyro_noise)


def finished(level, yaw, sigma=1e-9, source='fixed', grade=EXACT, latitude=LATITUDE):
    return make_alignment(level, yaw, sigma, source, False, Origin(latitude, 0.0, 0.0), grade,
                          grade.gyro_noise)


def variance_is_one(z):
    """Check z of (draws, ...) that are to have zero mean and unit variance."""
    n = len(z)
    # five sigmas of the mean and of the variance of n normal draws
    assert np.all(np.abs(z.mean(axis=0)) < 5 / np.sqrt(n))
    assert np.all(np.abs(z.var(axis=0) - 1) < 5 * np.sqrt(2 / n))


@pytest.mark.parametrize('rpy', [RPY, [0, 0, 0], [3.0, 0.1, -2.0], [0.0, 1.5, 0.5],
                                 [-0.4, -1.5, 3.1]])
def test_attitude_and_bias_at_rest_are_found_exactly(rpy):
    C_nb, bias = matrix_from_rpy(rpy), np.array([1e-4, -2e-4, 3e-4])
    level = levelled(rest(C_nb, gyro_bias=bias))
    assert level.t == pytest.approx(SECONDS - REST_EDGE, abs=1 / RATE)
    assert_allclose(level.C_Lb @ C_nb.T @ [0, 0, 1], [0, 0, 1], atol=1e-14)
    a = finished(level, rpy[2])
    assert_allclose(a.C_nb, C_nb, atol=1e-13)       # 9.8 m/s^2 averaged over 301 rows
    # Earth rate taken out on its own axes: 5e-5 rad/s would be left otherwise
    assert_allclose(a.gyro_bias, bias, atol=1e-16)


def test_ends_of_a_standstill_are_excluded_unless_nothing_else_is_left():
    C_nb = matrix_from_rpy(RPY)
    t, w, f = rest(C_nb)
    f[(t < REST_EDGE) | (t > SECONDS - REST_EDGE)] += [0.5, 0.0, 0.0]
    assert_allclose(levelled((t, w, f)).C_Lb @ C_nb.T @ [0, 0, 1], [0, 0, 1], atol=1e-14)
    ends = [0, -1]
    level = levelled((t[ends], w[ends], f[ends]))
    assert level.t == SECONDS
    assert np.isfinite(level.C_Lb).all()


@pytest.mark.parametrize('up', [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1e-9, -1e-9],
                                [1.0, 1e-4, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
def test_level_frame_is_a_rotation_for_any_imu_orientation(up):
    C = level_frame(9.8 * np.array(up))
    assert_allclose(C @ C.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(C) == pytest.approx(1, abs=1e-14)
    assert_allclose(C @ np.array(up) / np.linalg.norm(up), [0, 0, 1], atol=1e-14)


@pytest.mark.parametrize('grade', GRADES)
def test_level_error_agrees_with_its_sigma(grade):
    grade, rng = GRADES[grade], np.random.default_rng(1)
    C_nb, z = matrix_from_rpy(RPY), []
    for _ in range(DRAWS):
        # the component of g on a misaligned axis is a bias
        level = levelled(rest(C_nb, accel_bias=rng.normal(0, grade.level_bias, 3), grade=grade,
                              rng=rng, seconds=10.0), grade)
        up_seen = C_nb @ level.C_Lb[2]              # up of L in the true n
        z.append(up_seen[:2] / level.level_sigma)
    variance_is_one(np.array(z))


@pytest.mark.parametrize('latitude', [0.7, -0.7, 0.0, 1.4])
@pytest.mark.parametrize('yaw', [0.0, 1.0, np.pi / 2, 2.5, -3.0, -1.0])
def test_gyrocompass_points_north_in_every_quadrant(latitude, yaw):
    C_nb = matrix_from_rpy([0.1, -0.2, yaw])
    found, _ = gyrocompass(levelled(rest(C_nb, latitude)), latitude, EXACT)
    # 1e-16 of 7e-5 rad/s per row, over Omega cos(1.4 rad)
    assert wrap(found - yaw) == pytest.approx(0, abs=1e-9)
    assert -np.pi < found <= np.pi


@pytest.mark.parametrize(('grade', 'latitude'), [
    (GRADES['navigation'], 0.7), (GRADES['navigation'], -1.2),
    # accelerometer errors so large that the tilt matters: tan(1.3) = 3.6
    (replace(GRADES['navigation'], accel_bias=0.01), 1.3)])
def test_gyrocompass_error_agrees_with_its_sigma(grade, latitude):
    rng, C_nb, z = np.random.default_rng(2), matrix_from_rpy(RPY), []
    for _ in range(DRAWS):
        level = levelled(rest(C_nb, latitude, rng.normal(0, grade.gyro_bias, 3),
                              rng.normal(0, grade.accel_bias, 3), grade, rng), grade)
        yaw, sigma = gyrocompass(level, latitude, grade)
        z.append(wrap(yaw - RPY[2]) / sigma)
    variance_is_one(np.array(z))


def test_gyrocompass_states_an_unknown_heading_at_the_pole():
    _, sigma = gyrocompass(levelled(rest(np.eye(3), np.pi / 2)), np.pi / 2, EXACT)
    assert sigma > 1e6


@pytest.mark.parametrize(('grade', 'seconds', 'yaw_sigma'), [
    ('consumer', 10.0, 0.0175), ('consumer', 300.0, 0.0175),   # noise; the walk of the bias
    ('tactical', 60.0, 1e-4), ('tactical', 60.0, 0.04),        # noise; Earth rate on wrong axes
    ('industrial', 300.0, 0.5)])
def test_gyro_bias_error_agrees_with_its_sigma(grade, seconds, yaw_sigma):
    grade, rng = GRADES[grade], np.random.default_rng(3)
    C_nb, z = matrix_from_rpy([0.02, -0.03, 0.4]), []
    for _ in range(DRAWS):
        bias = rng.normal(0, grade.gyro_bias, 3)
        level = levelled(rest(C_nb, LATITUDE, bias, rng.normal(0, grade.accel_bias, 3), grade,
                              rng, seconds), grade)
        a = finished(level, 0.4 + rng.normal(0, yaw_sigma), yaw_sigma, grade=grade)
        z.append((a.gyro_bias - bias) / a.gyro_bias_sigma)
    z = np.array(z)
    if yaw_sigma < 0.1:
        variance_is_one(z)
    # so wrong a heading acts by its cosine too: a mean of its own; the size must still hold
    assert np.all(np.sqrt((z**2).mean(axis=0)) < 1.2)


@pytest.mark.parametrize(('source', 'yaw_sigma'), [('gyrocompass', 2e-3), ('course', 0.07)])
def test_gyro_bias_is_taken_from_the_grade_where_that_is_more_certain(source, yaw_sigma):
    """A gyrocompass has used up the east part; a course leaves 3.9e-6 rad/s on it."""
    grade, rng = GRADES['navigation'], np.random.default_rng(4)
    C_nb, z = np.eye(3), []       # b: x east, y north
    for _ in range(DRAWS):
        bias = rng.normal(0, grade.gyro_bias, 3)
        level = levelled(rest(C_nb, LATITUDE, bias, 0.0, grade, rng, 300.0), grade)
        yaw = gyrocompass(level, LATITUDE, grade)[0] if source == 'gyrocompass' else \
            rng.normal(0, yaw_sigma)
        a = finished(level, yaw, yaw_sigma, source, grade)
        assert a.gyro_bias_sigma[0] == pytest.approx(grade.gyro_bias, rel=1e-3)
        assert a.gyro_bias_sigma[2] < 0.6 * grade.gyro_bias
        z.append((a.gyro_bias - bias) / a.gyro_bias_sigma)
    # wrongly turned axes mix a little of east into north, so north is not asked for unit spread
    variance_is_one(np.array(z)[:, [0, 2]])
    assert np.sqrt((np.array(z)[:, 1]**2).mean()) < 1.2
