# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Geodetic positions from those in a local metric frame, for methods that use the ellipsoid.

The frame is a tangent plane of the ellipsoid (x east, y north, z up) at FRAME_LONGITUDE. Only its
latitude has a meaning.
"""

from collections.abc import Callable
import math

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import FixSamples, LOCAL, of_columns
from odocal_ros.nav.earth import C_en, ecef_from_geodetic, geodetic_from_ecef

# definition: in the Atlantic, so that the positions are not mistaken for real ones
FRAME_LONGITUDE = math.radians(-30.0)
# definition: normal gravity here, 9.806 m/s^2, differs least from that of other latitudes
USUAL_LATITUDE_DEG = 45.0
# m from the origin along an axis: there the vertical differs by 0.18 deg from the z axis.
# Judgement: larger values are map coordinates (UTM), which are not in a tangent plane
LARGEST_FRAME = 20_000.0
# m, least significant motion of positions, by GNSS and in a local frame. Judgement: a receiver at
# rest drifts by many metres, SLAM and motion capture by centimetres
GNSS_MOVES, LOCAL_MOVES = 20.0, 0.5


def geodetic_of(position: Floats, latitude_deg: float) -> tuple[Floats, Floats, Floats]:
    """
    Return latitude, longitude, rad, and height, m, from (n, 3) m in a local frame: (n,) each.

    NaN for positions beyond LARGEST_FRAME, and for the height if z is 0: the positions of 2D SLAM
    and AMCL have none.   latitude_deg : NaN for USUAL_LATITUDE_DEG.
    """
    latitude = math.radians(USUAL_LATITUDE_DEG if math.isnan(latitude_deg) else latitude_deg)
    with np.errstate(invalid='ignore'):      # a signalling NaN
        near = np.all(np.abs(position) <= LARGEST_FRAME, axis=1)[:, None]
    x, y, z = np.where(near, position, np.nan).T
    own_e = ecef_from_geodetic(latitude, FRAME_LONGITUDE, 0.0)
    # no matrix product: its last bits depend on the number of rows, so replay would differ
    r_e = np.stack([own + a * x + b * y + c * z for own, (a, b, c) in zip(
        own_e, C_en(latitude, FRAME_LONGITUDE), strict=True)])
    return geodetic_from_ecef(r_e.T)


def local_fixes(latitude_deg: float) -> Callable[..., FixSamples]:
    """Return a function that makes fixes from stamps, arrivals, positions and covariances."""
    def build(stamps: Ints, received: Ints, position: Floats, *covariance: Floats) -> FixSamples:
        n = len(stamps)
        known = np.full(n, 3 if covariance else 0)      # zeros and negative ones are unknown too
        given = covariance[0].reshape(n, 3, 3) if covariance else np.zeros((n, 3, 3))
        return of_columns(FixSamples, stamps, received, *geodetic_of(position, latitude_deg),
                          given, known, np.full(n, LOCAL))
    return build
