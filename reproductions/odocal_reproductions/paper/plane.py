# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale and yaw from two chords in a Gauss-Krueger plane, as in Shi et al. 2015: eq. (1)-(10)."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import wrap


def gauss_krueger(latitude: Floats | float, longitude: Floats | float, meridian: float,
                  ellipsoid: str = 'WGS84') -> tuple[Floats, Floats]:
    """
    Return northing, easting, m, from latitude, longitude, rad: (...), eq. (1)-(5).

    meridian : the central one, rad.   ellipsoid : its name in PROJ.
    """
    from pyproj import Proj
    proj = Proj(proj='tmerc', lon_0=np.rad2deg(meridian), x_0=500000.0, ellps=ellipsoid)
    easting, northing = proj(np.rad2deg(longitude), np.rad2deg(latitude))
    return np.asarray(northing), np.asarray(easting)


def chord(o: Floats, b: Floats, meridian: float) -> tuple[float, float]:
    """Return length, m, and grid bearing, rad, from o to b: latitude, longitude, rad."""
    (x0, x1), (y0, y1) = gauss_krueger(np.array([o[0], b[0]]), np.array([o[1], b[1]]), meridian)
    return float(np.hypot(x1 - x0, y1 - y0)), float(np.arctan2(y1 - y0, x1 - x0))


def by_chords(o: Floats, b: Floats, b_dr: Floats, K0: float,
              meridian: float) -> tuple[float, float]:
    """
    Return K and alpha_psi, rad, by the ratio of two chords and the angle between: eq. (6)-(10).

    o, b : start and end by the fixes, latitude, longitude, rad.   b_dr : end of the track from o,
    with scale K0 and yaw 0.   meridian : central meridian of the plane, rad.
    """
    (S1, bearing), (S2, bearing_dr) = chord(o, b, meridian), chord(o, b_dr, meridian)
    return K0 * S1 / S2, float(wrap(bearing - bearing_dr))
