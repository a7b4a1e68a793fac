# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Dead reckoning and the Earth: closed forms, order, symmetries, and the ellipsoid of pyproj."""

from drives import configured, drive
from hypothesis import given, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav import geodesy
from odocal_ros.nav.dead_reckoning import (
    dead_reckon,
    forward_b,
    mounting_from_forward,
    Origin,
    rough_scale,
    section_ratio,
    Track,
)
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy, quat_from_rotvec, skew
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.core
RADIUS = 20.0
X = np.array([1.0, 0.0, 0.0])


def quarter_turn(n):
    """Return the track of a left turn on the level in n epochs; its true end is (R, R, 0)."""
    t = np.linspace(0.0, 10.0, n + 1)
    q_nb = quat_from_rotvec(np.outer(t / 10 * np.pi / 2, [0, 0, 1]))
    return dead_reckon(t, q_nb, Travel(t, RADIUS * np.pi / 2 * t / 10, 0.0))


@pytest.mark.parametrize('n', [50, 100, 200])
def test_dead_reckoning_error_is_of_second_order(n):
    def miss(n):
        return np.linalg.norm(quarter_turn(n).P[-1] @ X - [RADIUS, RADIUS, 0])

    assert miss(n) / miss(2 * n) == pytest.approx(4, rel=1e-3)
    dpsi = np.pi / 2 / n       # closed form of the trapezoid: x cot x, x = dpsi / 2
    assert miss(n) == pytest.approx(RADIUS * np.sqrt(2) * (1 - dpsi / 2 / np.tan(dpsi / 2)),
                                    rel=1e-9)


@pytest.mark.parametrize('place', [(0.7, 2.0, 50.0), (-1.2, np.pi, 0.0), (np.pi / 2, 0.3, 10.0)])
def test_conversion_to_the_origin_frame_and_back_is_exact(place):
    origin = Origin(*place)
    n = np.random.default_rng(5).normal(0, 5e3, (20, 3))
    # ulp of 6.4e6 m, twice over
    assert_allclose(origin.to_n(origin.to_geodetic(n)), n, rtol=0, atol=5e-9)
    assert_allclose(origin.to_n(np.array(place)), 0, atol=1e-9)
    assert_allclose(origin.to_geodetic(np.array([0.0, 0.0, 7.0]))[2], place[2] + 7, atol=5e-9)


def test_track_is_interpolated_linearly_and_constant_outside_also_of_one_epoch():
    track = quarter_turn(4)
    assert_allclose(track.P_at(track.t), track.P, atol=1e-15)
    assert_allclose(track.P_at(3.75), (track.P[1] + track.P[2]) / 2, atol=1e-15)
    assert_allclose(track.P_at(np.array([-5.0, 50.0])), track.P[[0, -1]], atol=1e-15)
    assert track.P_at(np.zeros((2, 3))).shape == (2, 3, 3, 3)
    assert_allclose(track.C_nb_at(np.array([-5.0, 2.4, 2.6, 99.0])), matrix_from_rpy(
        np.outer(np.deg2rad([0, 22.5, 22.5, 90]), [0, 0, 1])), atol=1e-15)
    track = dead_reckon(np.array([3.0]), np.array([[0, 0, 0, 1.0]]),
                        Travel(np.array([0.0, 9.0]), np.array([0.0, 1.0]), 0.0))
    assert isinstance(track, Track)
    for t in (np.array(0.0), np.array(3.0), np.array([1.0, 5.0])):
        assert_allclose(track.P_at(t), 0, atol=0)
        assert_allclose(track.C_nb_at(t), np.broadcast_to(np.eye(3), (*t.shape, 3, 3)), atol=0)


@given(yaw=st.floats(-3.14, 3.14), pitch=st.floats(-1.5, 1.5), K=st.floats(0.01, 100))
def test_mounting_angles_and_forward_axis_are_inverse_functions(yaw, pitch, K):
    d = forward_b(yaw, pitch)
    assert_allclose(d, matrix_from_rpy([0, pitch, yaw])[0], atol=1e-15)   # C_bv e_x
    found = mounting_from_forward(K * d)
    if abs(abs(yaw) - np.pi / 2) > 1e-6:      # forward is along y there: no pitch
        # 1e-16 over cos yaw > 1e-6 for the pitch
        assert_allclose(found, [yaw, pitch], atol=1e-9)
    assert_allclose(forward_b(*found), d, atol=2e-15)


def fixes(metres, rng, sigma):
    p = np.zeros((len(metres), 3))
    p[:, 0] = metres
    return p + rng.normal(0, sigma, p.shape) * [1, 1, 2]


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('metres_per_count', [0.0213, 0.3])
def test_rough_scale_is_robust_to_noise_outliers_standstills_and_flicker(seed, metres_per_count):
    rng = np.random.default_rng(seed)
    t = np.arange(0, 900, 0.2)
    metres = 12 * np.clip(t - 60, 0, 90)
    p = fixes(metres, rng, 1.5)
    p[rng.uniform(size=len(t)) < 0.05] += rng.normal(0, 40, 3)
    flicker = rng.integers(0, 2, len(t)) * ((t < 60) | (t > 150))
    odometer = Travel(t, np.floor(metres / metres_per_count) + flicker, 1.0)
    # a section of 20 m has sqrt(2) * 1.5 m of noise: 10 %, the median of 50 sections 1.8 %;
    # lateral noise adds (2.1 / 20)^2 / 2 = 0.6 %, outliers in a tenth move the median by
    # 0.1 of a sigma; flicker of one count has no effect in motion
    assert rough_scale(odometer, t, p, 1.5) == pytest.approx(metres_per_count, rel=0.07)
    backwards = Travel(t, -odometer.s, 1.0)
    assert rough_scale(backwards, t, p, 1.5) == rough_scale(odometer, t, p, 1.5)


def test_rough_scale_of_a_loop_and_of_a_single_section():
    t = np.arange(0, 400, 0.2)
    turns = 10 * t / (100 / 2 / np.pi)
    p = 100 / 2 / np.pi * np.stack([np.cos(turns), np.sin(turns), 0 * t], -1)
    # 20 m of a circle of 100 m: the chord is 6.5 % short, of twice the length 24 %
    assert rough_scale(Travel(t, 500 * t, 1.0), t, p, 0.0) == pytest.approx(0.02, rel=0.25)
    few = np.array([0.0, 25.0])
    assert rough_scale(Travel(few, 50 * few, 1.0), few, np.outer(few, [1, 0, 0]), 1.5) == 0.02


@pytest.mark.parametrize(('noise', 'stated'), [(0.01, 0.01), (0.2, 0.01), (0.01, 2.5)])
def test_rough_scale_of_parallel_lanes_in_alternating_directions(noise, stated):
    rng, t = np.random.default_rng(3), np.arange(0, 600, 0.2)
    lane = 0.5 * t / 18
    along = 18 * np.abs((lane + 1) % 2 - 1)
    p = np.stack([along, 3.0 * np.floor(lane), 0 * t], -1) + rng.normal(0, noise, (len(t), 3))
    # of chords of at least eight sigmas in lanes of 18 m, less than half turn
    assert rough_scale(Travel(t, 5 * t, 1.0), t, p, stated) == pytest.approx(0.1, rel=0.1)


def test_rough_scale_requires_motion_in_fixes_and_odometer():
    rng, t = np.random.default_rng(12), np.arange(0, 60, 0.2)
    still, moving = Travel(t, 0 * t, 1.0), Travel(t, 100 * t, 1.0)
    assert rough_scale(moving, t, fixes(0 * t, rng, 1.5), 1.5) is None
    assert rough_scale(still, t, fixes(10 * t, rng, 1.5), 1.5) is None
    none = Travel(np.empty(0), np.empty(0), 1.0)
    assert rough_scale(none, t, fixes(10 * t, rng, 1.5), 1.5) is None
    assert rough_scale(moving, np.empty(0), np.empty((0, 3)), 1.5) is None
    assert rough_scale(moving, t + 1e3, fixes(10 * t, rng, 1.5), 1.5) is None


def test_chords_of_a_circle_are_compared_with_those_of_its_path():
    s = np.linspace(0.0, 100.0, 301)                # of a radius of 10
    path = 10 * np.stack([np.sin(s / 10), 1 - np.cos(s / 10)], -1)
    turned = path @ [[0.0, 1.0], [-1.0, 0.0]] * 0.7 + [3.0, -5.0]
    assert section_ratio(s, path, turned, 10.0) == pytest.approx(0.7, rel=1e-12)
    # a chord of 10 m on a radius of 7 m spans 2 asin(5 / 7) = 1.591 rad, 2 sin(x / 2) / x of it
    assert section_ratio(s, s[:, None], turned, 10.0) < 0.7 * 2 * (5 / 7) / 1.591
    assert section_ratio(s, path, 0 * turned, 10.0) is None


@pytest.mark.parametrize('seed', [1, 3, 4])
def test_reversing_in_a_yard_does_not_change_the_ratio(seed):
    """With RTK, whose 3 cm are 0.15 % of 20 m, and an industrial gyro: slopes, less than 1 %."""
    made = drive(scenario='yard', duration=300.0, fix_noise='rtk', imu_grade='industrial',
                 seed=seed)
    leg, config = made.leg(), configured(made)
    prepared, _ = prepare(leg, screen(leg, config)[0], config)
    assert prepared.path_ratio == pytest.approx(made.truth.scale, rel=0.01)


# Earth-fixed coordinates of 6.4e6 m have an ulp of 9.3e-10 m; three roundings
METRES = 3e-9
LATITUDES_DEG = [-90, -89.9999999, -60, -1e-9, 0, 1e-7, 33, 45, 89, 89.9999999, 90]
LONGITUDES_DEG = [-180, -179.9999999, -90, 0, 1e-9, 90, 120, 180]
HEIGHTS = [-400, 0, 50, 9000, 100e3]


def grid():
    lat, lon, h = np.meshgrid(LATITUDES_DEG, LONGITUDES_DEG, HEIGHTS)
    return np.deg2rad(lat.ravel()), np.deg2rad(lon.ravel()), h.ravel().astype(float)


def test_earth_fixed_coordinates_agree_with_pyproj():
    pyproj = pytest.importorskip('pyproj')
    to_ecef = pyproj.Transformer.from_crs('EPSG:4979', 'EPSG:4978', always_xy=True)
    lat, lon, h = grid()
    theirs = np.stack(to_ecef.transform(np.rad2deg(lon), np.rad2deg(lat), h), -1)
    # theirs goes by degrees: 180 deg have an ulp of 2.8e-14 deg, 3e-9 m on the ground
    assert_allclose(geodesy.ecef_from_geodetic(lat, lon, h), theirs, rtol=0, atol=2 * METRES)


def test_geodetic_conversion_is_inverted_also_at_poles_and_date_line():
    lat, lon, h = grid()
    r_e = geodesy.ecef_from_geodetic(lat, lon, h)
    lat2, lon2, h2 = geodesy.geodetic_from_ecef(r_e)
    assert_allclose(geodesy.ecef_from_geodetic(lat2, lon2, h2), r_e, rtol=0, atol=METRES)
    assert_allclose(h2, h, rtol=0, atol=METRES)
    assert_allclose(lat2, lat, rtol=0, atol=METRES / geodesy.SEMI_MAJOR_AXIS)
    b = geodesy.SEMI_MAJOR_AXIS * (1 - geodesy.F)
    lat, lon, h = geodesy.geodetic_from_ecef(np.array([0.0, 0.0, -b - 7.0]))
    assert lat == -np.pi / 2
    assert np.isfinite(lon)
    assert h == pytest.approx(7.0, abs=METRES)


def test_enu_axes_are_the_derivatives_of_the_position():
    lat, lon, h, d = 0.7, -2.1, 300.0, 1e-6
    C = geodesy.C_en(lat, lon)
    assert_allclose(C @ C.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(C) == pytest.approx(1, abs=1e-15)
    here = geodesy.ecef_from_geodetic
    # central differences of 1e-6 rad (6 m): 1e-9 m of round-off over 13 m
    for axis, step in ((0, (0, d, 0)), (1, (d, 0, 0)), (2, (0, 0, 10.0))):
        change = here(lat + step[0], lon + step[1], h + step[2]) - here(
            lat - step[0], lon - step[1], h - step[2])
        assert_allclose(change / np.linalg.norm(change), C[:, axis], atol=1e-9)


def test_radii_at_equator_and_pole_and_along_the_meridian_quadrant():
    a = geodesy.SEMI_MAJOR_AXIS
    b = a * (1 - geodesy.F)
    assert_allclose(geodesy.radii(0.0), [b**2 / a, a], rtol=1e-14)
    assert_allclose(geodesy.radii(np.pi / 2), [a**2 / b] * 2, rtol=1e-14)
    x, weight = np.polynomial.legendre.leggauss(20)
    lat = (x + 1) * np.pi / 4
    assert weight @ geodesy.radii(lat)[0] * np.pi / 4 == pytest.approx(10_001_965.729, abs=5e-4)


@pytest.mark.parametrize(('latitude_deg', 'gamma'), [
    (0, 9.7803253359), (90, 9.8321849378), (-90, 9.8321849378)])   # NIMA TR8350.2, table 3.4
def test_normal_gravity_is_the_published_one(latitude_deg, gamma):
    assert geodesy.gravity(np.deg2rad(latitude_deg), 0.0) == pytest.approx(gamma, abs=1e-10)


@pytest.mark.parametrize('latitude', [0.0, 0.6, -1.2, np.pi / 2])
def test_gravity_gradient_obeys_the_formula_of_bruns(latitude):
    """At the ellipsoid d gamma / dh = -gamma (1/M + 1/N) - 2 Omega^2, an identity."""
    meridian, normal = geodesy.radii(latitude)
    gamma = geodesy.gravity(latitude, 0.0)
    slope = (geodesy.gravity(latitude, 50.0) - geodesy.gravity(latitude, -50.0)) / 100
    # the formula leaves out 3/2 (F^2 + M_GAMMA^2) = 3.5e-5
    assert slope == pytest.approx(-gamma * (1 / meridian + 1 / normal) - 2 * geodesy.OMEGA**2,
                                  rel=4e-5)


def test_gravity_at_altitude_falls_with_the_square_of_the_distance():
    """At 20 km, minus the centrifugal part, as (R / (R + h))^2 to the third order left out."""
    h, omega2, a = 20e3, geodesy.OMEGA**2, geodesy.SEMI_MAJOR_AXIS
    bare = geodesy.gravity(0.0, 0.0) + omega2 * a
    there = bare * (a / (a + h))**2 - omega2 * (a + h)
    # third order: 4 (h / a)^3 = 1.2e-7; the quadrupole's faster fall: 2 * 1.5 J2 * 2 h / a = 2e-5
    assert geodesy.gravity(0.0, h) == pytest.approx(there, rel=2.5e-5)
    assert geodesy.gravity(0.0, h) == pytest.approx(9.780 - 0.0613, abs=2e-3)


@given(lat=st.floats(-1.4, 1.4), lon=st.floats(-3, 3))
def test_earth_rate_is_along_the_polar_axis_at_any_place(lat, lon):
    assert_allclose(geodesy.C_en(lat, lon) @ geodesy.earth_rate_n(lat), [0, 0, geodesy.OMEGA],
                    atol=1e-19)


@given(lat=st.floats(-1.4, 1.4), ve=st.floats(-60, 60), vn=st.floats(-60, 60))
def test_transport_rate_is_the_rotation_of_enu_along_a_path(lat, ve, vn):
    h, dt = 200.0, 1e-3
    meridian, normal = geodesy.radii(lat)
    dlat, dlon = vn / (meridian + h) * dt, ve / (normal + h) / np.cos(lat) * dt
    change = geodesy.C_en(lat + dlat, dlon) - geodesy.C_en(lat - dlat, -dlon)
    w = geodesy.transport_rate_n(lat, h, np.array([ve, vn, 1.0]))
    # differences of 1e-16 over 2 ms; 60 m/s is 5e-5 rad/s at 80 deg
    assert_allclose(geodesy.C_en(lat, 0.0).T @ change / (2 * dt), skew(w), atol=3e-13)
