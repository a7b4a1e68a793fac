# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The linear error model against finite differences of the actual dead reckoning."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_reproductions.paper import error_model
from odocal_reproductions.paper.error_model import coefficients, PAPER_RADIUS, propagate
from odocal_reproductions.paper.path import Path, planned_path
from odocal_ros.nav.dead_reckoning import dead_reckon, forward_b, Origin
from odocal_ros.nav.geodesy import C_en, earth_rate_n, OMEGA, radii
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import exp_so3, matrix_from_quat, quat_from_matrix, transpose
from odocal_ros.nav.strapdown import attitude
from odocal_ros.sim.motion import attitude as true_attitude
from odocal_ros.sim.scenarios import SimOptions, simulate
from odocal_ros.sim.sensors import imu_rotation

pytestmark = pytest.mark.core
RATE = 100.0
FORWARD = forward_b(np.deg2rad(1.0), np.deg2rad(0.4))
# of phi (rad), dL, dlam (rad), dh (m), eps (rad/s): each moves the end by a metre or so
STEP = np.array([1e-4, 1e-4, 1e-4, 1e-7, 1e-7, 1.0, 1e-7, 1e-7, 1e-7])


@pytest.fixture(scope='module')
def town():
    """Return t, w_b, travel, start (rad, rad, m) and attitude of a hilly drive with turns."""
    drive = simulate(SimOptions(scenario='town', imu_grade='perfect', imu_rate=RATE, slope=0.06,
                                duration=400.0, seed=3))
    t = (drive.imu.stamp_ns - drive.options.start_ns) * 1e-9
    state = drive.motion.at(t)
    start = np.array([state.latitude[0], state.longitude[0], state.height[0]])
    C_nb = true_attitude(drive.motion.at(t[:1]))[0] @ imu_rotation(drive.options)
    return t, drive.imu.w_i, Travel(t, state.travel, 0.0), start, C_nb


def reckon(town, x_0, eps_b):
    """Run dead reckoning with states x_0 at the start; return the track and the origin of n."""
    t, w_b, travel, start, C_nb = town
    origin = Origin(*(start + x_0[3:]))
    epochs, q_nb = attitude(t, w_b + eps_b, quat_from_matrix(exp_so3(-x_0[:3]) @ C_nb),
                            earth_rate_n(origin.latitude))
    return dead_reckon(epochs, q_nb, travel), origin


def path_of(track, origin):
    """Return the path of a dead-reckoned leg."""
    latitude, longitude, height = origin.to_geodetic(track.P @ FORWARD).T
    C_ln = transpose(C_en(latitude, longitude)) @ C_en(origin.latitude, origin.longitude)
    step_n = np.diff(track.P @ FORWARD, axis=0) / np.diff(track.t)[:, None]
    velocity = np.einsum('mij,mj->mi', (C_ln[:-1] + C_ln[1:]) / 2, step_n)
    C_nb = C_ln @ matrix_from_quat(track.q_nb)
    return Path(track.t, latitude, longitude, height, velocity, C_nb)


def in_fixed_axes(path, x, origin):
    """Return psi (rad) and dr (m) in the n of the origin, as error_model's text relates them."""
    phi, dL, dlam, dh = x[:, :3], x[:, 3], x[:, 4], x[:, 5]
    s, c = np.sin(path.latitude), np.cos(path.latitude)
    meridian, normal = radii(path.latitude)
    dtheta = np.stack([-dL, dlam * c, dlam * s], -1)
    dr = np.stack([(normal + path.height) * c * dlam, (meridian + path.height) * dL, dh], -1)
    C_nl = transpose(C_en(origin.latitude, origin.longitude)) @ C_en(path.latitude, path.longitude)
    return np.einsum('mij,mj->mi', C_nl, phi - dtheta), np.einsum('mij,mj->mi', C_nl, dr)


def level_state(track, origin, k):
    """Return position (3,) and attitude against the local level there of epoch k."""
    position = origin.to_geodetic(track.P[k] @ FORWARD)
    C_nl = transpose(C_en(origin.latitude, origin.longitude)) @ C_en(*position[:2])
    return position, C_nl.T @ matrix_from_quat(track.q_nb[k])


def difference(town, column, k):
    """Return the change of the states at epochs k by one unit of a start state or drift."""
    step = np.zeros(9)
    step[column] = STEP[column]
    plus, minus = ([level_state(*run, i) for i in k] for run in (
        reckon(town, step[:6], step[6:]), reckon(town, -step[:6], -step[6:])))
    changes = []
    for (p, C), (q, D) in zip(plus, minus, strict=True):     # positions, attitudes
        turn = C @ D.T                       # = I - [2 phi x]
        phi = np.array([turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2],
                        turn[0, 1] - turn[1, 0]]) / 2
        changes.append(np.concatenate([phi, p - q]) / (2 * STEP[column]))
    return np.array(changes)


def state_units(path, k):
    """Return the length, m, of one unit of each state at epochs k; of an angle phi, 1 m."""
    meridian, normal = radii(path.latitude[k])
    return np.stack([np.ones_like(meridian)] * 3
                    + [meridian, normal * np.cos(path.latitude[k]), np.ones_like(meridian)], -1)


@pytest.mark.parametrize('column', range(9))
def test_the_model_is_the_derivative_of_the_real_dead_reckoning(town, column):
    track, origin = reckon(town, np.zeros(6), np.zeros(3))
    path = path_of(track, origin)
    k = np.linspace(0, len(path.t) - 1, 12).astype(int)[1:]
    unit = np.eye(9)[column]
    start = unit[:6]       # the states themselves are not tested: only their change is
    model = propagate(path, start, unit[6:])[k] - start
    real = difference(town, column, k) - start
    # both sum by trapezoids: second order in the turn per sample, 0.4 rad/s / 100 Hz, so
    # (4e-3)^2 / 12 = 1.3e-6; round-off 1e-15 rad and 2e-9 m
    for rows, round_off in ((slice(0, 3), 1e-15), (slice(3, 6), 2e-9)):
        a, b = (model * state_units(path, k))[:, rows], (real * state_units(path, k))[:, rows]
        assert_allclose(a, b, rtol=0, atol=3e-6 * np.abs(b).max() + round_off / STEP[column])


def test_fixed_axes_show_the_error_of_strapdown_and_dead_reckoning(town):
    phi_0, eps_b = np.array([2e-4, -1e-4, 3e-4]), np.array([3e-7, 1e-7, -2e-7])
    x_0 = np.concatenate([phi_0, np.zeros(3)])
    track, origin = reckon(town, np.zeros(6), np.zeros(3))
    path = path_of(track, origin)
    psi, dr = in_fixed_axes(path, propagate(path, x_0, eps_b), origin)
    (plus, _), (minus, _) = reckon(town, x_0, eps_b), reckon(town, -x_0, -eps_b)
    turn = matrix_from_quat(plus.q_nb) @ transpose(matrix_from_quat(minus.q_nb))
    measured_psi = np.stack([turn[:, 1, 2] - turn[:, 2, 1], turn[:, 2, 0] - turn[:, 0, 2],
                             turn[:, 0, 1] - turn[:, 1, 0]], -1) / 4
    # trapezoids as above, and phi^2 = 1e-7 of the terms of third order
    assert_allclose(psi, measured_psi, rtol=0, atol=4e-6 * np.abs(measured_psi).max())
    assert_allclose(dr, (plus.P - minus.P) @ FORWARD / 2, rtol=0, atol=4e-6 * np.abs(dr).max())


def test_without_drift_the_error_in_fixed_axes_rotates_by_the_earth_only(town):
    track, origin = reckon(town, np.zeros(6), np.zeros(3))
    path = path_of(track, origin)
    psi_0 = np.array([1e-4, 2e-4, -3e-4])
    psi, _ = in_fixed_axes(path, propagate(path, [*psi_0, 0, 0, 0], np.zeros(3)), origin)
    rotated_psi = exp_so3(-earth_rate_n(origin.latitude) * (path.t - path.t[0])[:, None]) @ psi_0
    # the path's velocities are means over an interval, turned by the mean attitude of the level:
    # second order in the turn of the level per step, 1e-8; transport itself is 1e-3 of psi
    assert_allclose(psi, rotated_psi, rtol=0, atol=1e-7 * np.abs(psi_0).max())


def test_the_height_has_the_rates_of_the_sphere_without_feedback():
    F = coefficients(np.deg2rad(40.0), 0.0, [14.0, 14.0, 0.0], PAPER_RADIUS)
    # dh: the third row of (21)
    assert_allclose(F[5], [-14.0, 14.0, 0, 0, 0, 0])
    assert (F[:, 5] == 0).all()


@pytest.mark.parametrize('latitude', [-0.9, 0.0, 0.7])
def test_the_sphere_follows_the_printed_equations_at_any_velocity(latitude):
    R, w, vE, vN = PAPER_RADIUS, OMEGA, -7.0, 19.0
    s, c, tan = np.sin(latitude), np.cos(latitude), np.tan(latitude)
    # eq. (15)-(17), (22), (23), corrected, as on the page
    rows = [[0, w * s + vE * tan / R, -w * c, 0, 0],
            [-(w * s + vE * tan / R), 0, 0, -w * s, 0],
            [w * c + vE / R, vN / R, vN * tan / R, w * c + vE / c**2 / R, 0],
            [0, 0, -vE / R, 0, 0],
            [0, 0, vN / c / R, vE / c * tan / R, 0]]
    F = coefficients(latitude, 300.0, [vE, vN, 1.5], R)
    assert_allclose(F[:5, :5], rows, rtol=1e-14, atol=1e-20)


@pytest.mark.parametrize('n', [1, 2, 3, 4, 63, 64, 65, 129, 500, 4097, 4500])
def test_running_products_equal_those_of_a_loop(n):
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(5.0, 15.0, n))
    path = planned_path(t, rng.uniform(0, 30, n), rng.uniform(-3, 3, n), 0.6)
    eps_b = rng.standard_normal((max(n - 1, 0), 3)) * 1e-6
    x = x_0 = rng.standard_normal(6) * 1e-3
    loop = [x]
    for transition in error_model._transitions(path, None, eps_b[..., None])[1:]:
        loop.append(transition[:, :6] @ loop[-1] + transition[:, 6])
    # rounding of n products
    scale, atol = np.abs(loop).max(axis=0), 1e-15 * n
    assert_allclose(propagate(path, x_0, eps_b) / scale, loop / scale, rtol=0, atol=atol)
    assert_allclose(propagate(path, x_0, [1e-6, 0, 2e-6])[0], x_0)


def test_the_series_is_of_second_order():
    x_0, eps_b = np.array([1e-3, -2e-3, 3e-3, 1e-6, 0, 5.0]), np.array([1e-6, 2e-6, -1e-6])

    def end(n):
        path = planned_path(np.linspace(0, 3000, n + 1), np.full(n + 1, 30.0), 0.4, 0.7)
        # one latitude for all steps: only the exponential is tested
        level = replace(path, latitude=np.full(n + 1, 0.7))
        return propagate(level, x_0, eps_b)[-1]

    best = end(6400)
    errors = [np.abs((end(n) - best) / best)[:3].max() for n in (10, 20, 40)]
    # second order over a fixed time: error per step of third order, so 4 in all
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)


def test_a_planned_drive_equals_the_simulated_one():
    drive = simulate(SimOptions(scenario='paper', imu_grade='perfect', imu_rate=10.0, yaw=0.0))
    t = (drive.imu.stamp_ns - drive.options.start_ns) * 1e-9
    state = drive.motion.at(t)
    path = planned_path(t, state.speed, state.yaw, state.latitude[0], state.longitude[0],
                        state.height[0])
    # speed is linear between samples, yaw constant: only the radii are taken at the middle of a
    # step, 2 m: nothing; round-off of 1e4 sums of 1e-6 rad
    assert_allclose(path.latitude, state.latitude, rtol=0, atol=1e-13)
    assert_allclose(path.longitude, state.longitude, rtol=0, atol=1e-13)
    assert_allclose(path.travel, state.travel, atol=1e-7)
    assert_allclose(path.C_nb, true_attitude(state), atol=1e-15)
