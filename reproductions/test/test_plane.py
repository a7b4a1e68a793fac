# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The Gauss-Krueger plane against the arc of meridian and the geodesic."""

import numpy as np
from pyproj import Geod
import pytest

from odocal_reproductions.paper.plane import chord, gauss_krueger

MERIDIAN = np.deg2rad(116.0)


def test_on_the_central_meridian_northing_is_the_arc():
    """A quarter of the meridian: 10 001 965.729 m (WGS 84), eq. (1) with m = 0."""
    north, east = gauss_krueger(np.pi / 2, MERIDIAN, MERIDIAN)
    assert north == pytest.approx(10_001_965.729, abs=5e-4)
    assert east == pytest.approx(500_000.0, abs=1e-6)


@pytest.mark.parametrize('latitude_deg', [-70.0, 0.0, 40.0, 84.0])
def test_plane_about_a_leg_keeps_lengths_and_bearings(latitude_deg):
    """11 km, half each side of the meridian: as the geodesic."""
    lat, R = np.deg2rad(latitude_deg), 6.37e6
    dlat, dlon = 4e3 / R, 4e3 / R / np.cos(lat)
    start, end = (lat - dlat, MERIDIAN - dlon), (lat + dlat, MERIDIAN + dlon)
    length, bearing = chord(start, end, MERIDIAN)
    azimuth, _, geodesic = Geod(ellps='WGS84').inv(*start[::-1], *end[::-1], radians=True)
    # scale: mean of (x / R)^2 / 2 over +-4 km: 6.6e-8
    assert length / geodesic == pytest.approx(1 + (4e3 / R)**2 / 6, abs=2e-8)
    # the azimuth is against true north at the start, 4 km off the meridian:
    convergence = -dlon * np.sin(lat - dlat)
    assert bearing == pytest.approx(azimuth - convergence, abs=3e-6)
