# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Plane coordinates (leg-centred, Gauss-Krueger, UTM) and geodesics, by pyproj."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.settings.config import ProjectionConfig

# semi-major axis m, inverse flattening
ELLIPSOIDS = {'WGS84': (6378137.0, 298.257223563), 'CGCS2000': (6378137.0, 298.257222101),
              'Krassovsky': (6378245.0, 298.3)}
ZONE_WIDTH = 6.0       # deg, of UTM and of Gauss-Krueger's wide zones: format


@dataclass(frozen=True)
class Plane:
    """A transverse Mercator plane."""

    central_meridian: float     # deg
    scale: float = 1.0          # on the central meridian
    ellipsoid: str = 'WGS84'    # a name of ELLIPSOIDS

    def forward(self, latitude: Floats, longitude: Floats) -> tuple[Floats, Floats]:
        """Return northing, easting, m (eq. 1-5 of Shi et al. 2015), from rad: (...)."""
        from pyproj import Proj
        a, rf = ELLIPSOIDS[self.ellipsoid]
        proj = Proj(proj='tmerc', lat_0=0, lon_0=self.central_meridian, k_0=self.scale,
                    x_0=500000.0, y_0=0, a=a, rf=rf)
        easting, northing = proj(np.rad2deg(longitude), np.rad2deg(latitude))
        return np.asarray(northing), np.asarray(easting)


def plane_for(projection: ProjectionConfig, longitude: float) -> Plane:
    """Return the plane by the projection settings for a longitude, rad."""
    degrees = float(np.rad2deg(longitude))
    meridian = projection.central_meridian
    if np.isnan(meridian):
        zone = ZONE_WIDTH * np.floor(degrees / ZONE_WIDTH) + ZONE_WIDTH / 2
        meridian = degrees if projection.kind == 'leg' else zone
    scale = {'leg': 1.0, 'gauss_krueger': 1.0, 'utm': 0.9996}
    return Plane(float(meridian), scale[projection.kind], projection.ellipsoid)


def plane_chord(plane: Plane, start: Sequence[float] | Floats,
                end: Sequence[float] | Floats) -> tuple[float, float]:
    """Return length, m, and grid bearing, rad, of a chord between latitudes, longitudes, rad."""
    (n0, n1), (e0, e1) = plane.forward(np.array([start[0], end[0]]), np.array([start[1], end[1]]))
    return float(np.hypot(n1 - n0, e1 - e0)), float(np.arctan2(e1 - e0, n1 - n0))


def geodesic_chord(start: Sequence[float] | Floats,
                   end: Sequence[float] | Floats) -> tuple[float, float]:
    """Return length at the mean height, m, and azimuth, rad, of the WGS 84 geodesic."""
    from pyproj import Geod
    azimuth, _, length = Geod(ellps='WGS84').inv(
        np.rad2deg(start[1]), np.rad2deg(start[0]), np.rad2deg(end[1]), np.rad2deg(end[0]))
    height = (start[2] + end[2]) / 2
    return float(length * (1 + height / 6371008.8)), float(np.deg2rad(azimuth))
