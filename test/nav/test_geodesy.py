# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Earth against pyproj, published figures and identities of the ellipsoid."""

from hypothesis import given, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav import geodesy
from odocal_ros.nav.rotations import skew

pytestmark = pytest.mark.core

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
