# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Planes and geodesics: lengths, bearings, zones and heights."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.nav.geodesy import (
    ecef_from_geodetic,
    geodesic_chord,
    Plane,
    plane_chord,
    plane_for,
)
from odocal_ros.settings.config import ProjectionConfig

pytest.importorskip('pyproj')


def test_on_the_central_meridian_northing_is_the_arc_and_the_scale_0_9996():
    """A quarter of the meridian: 10 001 965.729 m (WGS 84), eq. (1) with m = 0."""
    north, east = Plane(9.0).forward(np.pi / 2, np.deg2rad(9.0))
    assert north == pytest.approx(10_001_965.729, abs=5e-4)
    assert east == pytest.approx(500_000.0, abs=1e-6)
    start, end = np.array([0.7, np.deg2rad(9.0), 0.0]), np.array([0.7001, np.deg2rad(9.0), 0.0])
    plane = plane_for(ProjectionConfig(kind='utm'), np.deg2rad(9.3))
    assert plane_chord(plane, start, end)[0] / geodesic_chord(start, end)[0] == pytest.approx(
        0.9996, abs=1e-8)       # 0.1 mm of 637 m: what PROJ's series is good for


@pytest.mark.parametrize(('degrees', 'zone'), [
    (116.0, 117.0), (-0.1, -3.0), (0.0, 3.0), (5.99, 3.0), (6.0, 9.0), (-180.0, -177.0)])
def test_zone_of_a_longitude(degrees, zone):
    required = ProjectionConfig(kind='gauss_krueger', ellipsoid='Krassovsky')
    assert plane_for(required, np.deg2rad(degrees)) == Plane(zone, 1.0, 'Krassovsky')
    given = replace(required, central_meridian=114.0)
    assert plane_for(given, np.deg2rad(degrees)) == Plane(114.0, 1.0, 'Krassovsky')


@pytest.mark.parametrize('middle_deg', [0.0, 116.0, 179.999, 180.0, -180.0, -179.999])
@pytest.mark.parametrize('latitude_deg', [-70.0, 0.0, 40.0, 84.0])
def test_plane_about_a_leg_keeps_lengths_and_bearings_anywhere(middle_deg, latitude_deg):
    """11 km, half each side of the meridian, the date line too: as the geodesic."""
    lat, lon = np.deg2rad(latitude_deg), np.deg2rad(middle_deg)
    dlat, dlon = 4e3 / 6.37e6, 4e3 / 6.37e6 / np.cos(lat)
    start, end = np.array([lat - dlat, lon - dlon, 0.0]), np.array([lat + dlat, lon + dlon, 0.0])
    start[1], end[1] = ((x + np.pi) % (2 * np.pi) - np.pi for x in (start[1], end[1]))
    length, bearing = plane_chord(plane_for(ProjectionConfig(), lon), start, end)
    geodesic, azimuth = geodesic_chord(start, end)
    # scale: mean of (x / R)^2 / 2 over +-4 km: 6.6e-8
    assert length / geodesic == pytest.approx(1 + (4e3 / 6.37e6)**2 / 6, abs=2e-8)
    # the azimuth is against true north at the start, 4 km off the meridian:
    convergence = -dlon * np.sin(lat - dlat)
    assert bearing == pytest.approx(azimuth - convergence, abs=3e-6)


def test_a_geodesic_is_longer_at_height():
    """Without a height of 1000 m a geodesic is 0.016 % shorter: h over the Earth radius."""
    start, end = np.array([0.7, 2.0, 1000.0]), np.array([0.7003, 2.0002, 1000.0])
    length, azimuth = geodesic_chord(start, end)
    on_ground, same = geodesic_chord(start * [1, 1, 0], end * [1, 1, 0])
    assert 100 * (length / on_ground - 1) == pytest.approx(0.016, rel=0.02)
    assert azimuth == same
    # a straight line in space is shorter than the arc by (L / R)^2 / 24 = 5e-9; the radius along
    # the line is within 0.4 % of the mean one, and h / R 1.6e-4 of that: 6e-7
    straight = np.linalg.norm(ecef_from_geodetic(*start) - ecef_from_geodetic(*end))
    assert length == pytest.approx(straight, rel=7e-7)
