# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The Earth: WGS 84 ellipsoid, gravity and rates; geodetic, Earth-fixed and local coordinates.

A local metric frame is a tangent plane of the ellipsoid (x east, y north, z up) at
FRAME_LONGITUDE, for methods that use the ellipsoid. The longitude is arbitrary.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import FloatOrFloats, Floats, Ints
from odocal_ros.data.samples import FixSamples, from_columns, LOCAL_STATUS
from odocal_ros.nav.rotations import arctan2

# physical: all of WGS 84 (NIMA TR8350.2)
SEMI_MAJOR_AXIS = 6378137.0    # m
F = 1 / 298.257223563          # flattening
E2 = F * (2 - F)               # first eccentricity squared
OMEGA = 7.292115e-5            # rad/s, Earth rate
# definition: in the Atlantic, so that the positions are not mistaken for real ones
FRAME_LONGITUDE = math.radians(-30.0)
# definition: normal gravity here, 9.806 m/s^2, differs least from that of other latitudes
USUAL_LATITUDE_DEG = 45.0
# m from the origin along an axis: there the vertical differs by 0.18 deg from the z axis.
# Judgement: larger values are map coordinates (UTM), which are not in a tangent plane
LARGEST_FRAME = 20_000.0
# m, smallest motion that positions of GNSS and of a local frame show. Judgement: a receiver
# at rest drifts by many metres, SLAM and motion capture by centimetres
MIN_GNSS_MOTION, MIN_LOCAL_MOTION = 20.0, 0.5


def radii(latitude: FloatOrFloats) -> tuple[FloatOrFloats, FloatOrFloats]:
    """Return meridian and normal radius of curvature, m, at a latitude, rad: (...)."""
    w2 = 1 - E2 * np.sin(latitude) ** 2
    normal = SEMI_MAJOR_AXIS / np.sqrt(w2)
    return normal * (1 - E2) / w2, normal


def gravity(latitude: FloatOrFloats, height: FloatOrFloats) -> FloatOrFloats:
    """Return normal gravity, m/s^2, at latitude (rad) and height (m) (NIMA TR8350.2, 4-1, 4-3)."""
    s2 = np.sin(latitude) ** 2
    gamma_e = 9.7803253359    # m/s^2, normal gravity at the equator
    k_gamma = 0.00193185265241    # Somigliana's constant
    gamma_0 = gamma_e * (1 + k_gamma * s2) / np.sqrt(1 - E2 * s2)
    m_gamma = 0.00344978650684    # omega^2 a^2 b / GM
    gamma: FloatOrFloats = gamma_0 * (
        1 - 2 / SEMI_MAJOR_AXIS * (1 + F + m_gamma - 2 * F * s2) * height
        + 3 / SEMI_MAJOR_AXIS**2 * height**2)
    return gamma


def earth_rate_n(latitude: ArrayLike) -> Floats:
    """Return the Earth's turn rate in ENU, rad/s: (...) to (..., 3)."""
    latitude = np.asarray(latitude, dtype=float)
    zero = np.zeros_like(latitude)
    return np.stack([zero, OMEGA * np.cos(latitude), OMEGA * np.sin(latitude)], -1)


@dataclass(frozen=True)
class PartlyKnownRate:
    """The Earth's turn rate in a frame with unknown north: known part, and 1 sigma, rad/s."""

    rate_n: tuple[float, float, float]
    sigma_n: tuple[float, float, float]


def rate_without_north(latitude: float) -> PartlyKnownRate:
    """Return the Earth rate in a level frame of unknown azimuth; latitude: rad, NaN: unknown."""
    if np.isnan(latitude):
        return PartlyKnownRate((0.0, 0.0, 0.0), (OMEGA, OMEGA, OMEGA))
    level = float(OMEGA * np.cos(latitude) / np.sqrt(2))
    return PartlyKnownRate((0.0, 0.0, float(OMEGA * np.sin(latitude))), (level, level, 0.0))


def transport_rate_n(latitude: Floats, height: Floats, velocity_n: Floats) -> Floats:
    """Return the turn rate of the local level relative to the Earth, ENU, rad/s: (..., 3)."""
    meridian, normal = radii(latitude)
    east, north = velocity_n[..., 0], velocity_n[..., 1]
    return np.stack([-north / (meridian + height), east / (normal + height),
                     east * np.tan(latitude) / (normal + height)], -1)


def ecef_from_geodetic(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
    """Return Earth-fixed coordinates, m, from geodetic ones, rad, rad, m: (...) to (..., 3)."""
    latitude, longitude, height = np.broadcast_arrays(latitude, longitude, height)
    normal = radii(latitude)[1]
    level = (normal + height) * np.cos(latitude)
    return np.stack([level * np.cos(longitude), level * np.sin(longitude),
                     (normal * (1 - E2) + height) * np.sin(latitude)], -1)


def geodetic_from_ecef(r_e: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude, rad, height, m, of (..., 3) m (Bowring; within 1e-9 m)."""
    x, y, z = np.moveaxis(np.asarray(r_e, dtype=float), -1, 0)
    b = SEMI_MAJOR_AXIS * (1 - F)
    p = np.hypot(x, y)
    beta = arctan2(SEMI_MAJOR_AXIS * z, b * p)
    for _ in range(3):
        latitude = arctan2(z + E2 / (1 - E2) * b * np.sin(beta) ** 3,
                           p - E2 * SEMI_MAJOR_AXIS * np.cos(beta) ** 3)
        beta = arctan2((1 - F) * np.sin(latitude), np.cos(latitude))
    s, c = np.sin(latitude), np.cos(latitude)
    height = p * c + z * s - SEMI_MAJOR_AXIS * np.sqrt(1 - E2 * s * s)
    return latitude, arctan2(y, x), height


def C_en(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    """Return the rotation from ENU to Earth-fixed axes: (...) to (..., 3, 3)."""
    latitude, longitude = np.broadcast_arrays(latitude, longitude)
    sp, cp, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(sp)
    return np.stack([np.stack([-sl, -sp * cl, cp * cl], -1),
                     np.stack([cl, -sp * sl, cp * sl], -1),
                     np.stack([zero, cp, sp], -1)], -2)


def geodetic_from_local(position: Floats, latitude_deg: float) -> tuple[Floats, Floats, Floats]:
    """
    Return latitude, longitude, rad, and height, m, from (n, 3) m in a local frame: (n,) each.

    NaN for positions beyond LARGEST_FRAME, and for the height if z is 0: 2D SLAM and AMCL do not
    measure it (decision 21).   latitude_deg : NaN for USUAL_LATITUDE_DEG.
    """
    latitude = math.radians(USUAL_LATITUDE_DEG if math.isnan(latitude_deg) else latitude_deg)
    with np.errstate(invalid='ignore'):      # a signalling NaN
        in_range = np.all(np.abs(position) <= LARGEST_FRAME, axis=1)[:, None]
    x, y, z = np.where(in_range, position, np.nan).T
    origin_e = ecef_from_geodetic(latitude, FRAME_LONGITUDE, 0.0)
    # no matrix product: its last bits depend on the number of rows, so replay would differ
    r_e = np.stack([origin + a * x + b * y + c * z for origin, (a, b, c) in zip(
        origin_e, C_en(latitude, FRAME_LONGITUDE), strict=True)])
    lat, longitude, height = geodetic_from_ecef(r_e.T)
    return lat, longitude, np.where(z == 0, np.nan, height)


def local_fixes(latitude_deg: float) -> Callable[..., FixSamples]:
    """Return a function that makes fixes from stamps, arrivals, positions and covariances."""
    def build(stamps: Ints, received: Ints, position: Floats, *covariance: Floats) -> FixSamples:
        n = len(stamps)
        # covariance type of NavSatFix: 3 known, 0 unknown; zeros and negative ones are unknown too
        covariance_type = np.full(n, 3 if covariance else 0)
        covariance_n = covariance[0].reshape(n, 3, 3) if covariance else np.zeros((n, 3, 3))
        geodetic = geodetic_from_local(position, latitude_deg)
        return from_columns(FixSamples, stamps, received, *geodetic, covariance_n,
                            covariance_type, np.full(n, LOCAL_STATUS))
    return build
