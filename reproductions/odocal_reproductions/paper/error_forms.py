# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Closed forms of Shi et al.'s error analysis: plane, chord, straight leg (eq. 11-14, 29-33).

All errors are estimate less truth (the paper's (30)-(33) print the reverse). K is
the scale factor, alpha the yaw mounting angle (alpha_psi of the paper), phi_U the heading error.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats

# m, physical: polar radius of curvature of Krassovsky's ellipsoid, eq. (1)-(5)
C = 6399698.9018


def plane_error(latitude: Floats | float, longitude: Floats | float, central_meridian: float,
                dL: Floats | float, dlam: Floats | float) -> tuple[Floats | float, Floats | float]:
    """
    Return northing and easting error dx, dy, m, of dL, dlam, rad: eq. (13), (14), corrected.

    Good for an error budget within 3 deg of the central meridian (all in rad) and at 20 to 50 deg
    of latitude: dx by dL to 1.2e-5, the cross terms to 1 %, dy by dlam to 0.3 %.
    """
    s, c = np.sin(latitude), np.cos(latitude)
    to_meridian = central_meridian - longitude
    c0, c1 = 6367558.49686, 32005.79642    # m, of the arc of meridian
    dx = ((c0 + c1 * (s * s - c * c) + C / 2 * np.cos(2 * latitude) * to_meridian**2) * dL
          - C * s * c * to_meridian * dlam)
    return dx, C * s * to_meridian * dL + C * c * dlam


def chord_error(x: Floats | float, y: Floats | float, dx: Floats | float, dy: Floats | float,
                S1: Floats | float, K0: float) -> tuple[Floats | float, Floats | float]:
    """
    Return dK (unit of K0) and dalpha (rad) of an error of the dead-reckoned end: eq. (11), (12).

    x, y : dead-reckoned end from the start, north and east, m.   dx, dy : its error, m.
    S1 : true chord, m.   K0 : configured scale.
    """
    S2 = np.hypot(x, y)
    return -K0 * S1 / S2**3 * (x * dx + y * dy), (y * dx - x * dy) / S2**2


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """Travel of a straight leg over time, which gives dalpha and dK of any heading error."""

    t: NDArray[np.float64]    # (m,) s
    s: NDArray[np.float64]    # (m,) m, travel; constant speed between epochs

    def mean(self, x: Floats) -> float:
        """Return the distance-weighted mean of (m,) values, linear between epochs."""
        return float(self._weight @ (x[1:] + x[:-1]) / 2)

    def variance(self, x: Floats) -> float:
        """Return the distance-weighted variance."""
        a, b = x[:-1] - self.mean(x), x[1:] - self.mean(x)
        return float(self._weight @ (a * a + a * b + b * b) / 3)

    def mounting_error(self, phi_U: Floats) -> tuple[float, float]:
        """
        Return dalpha (rad) and dK / K of a straight leg of this profile: (29)-(33) generalised.

        phi_U : (m,) heading error at the epochs, rad.   To second order.
        """
        return -self.mean(phi_U), self.variance(phi_U) / 2

    def heading_and_drift(self, phi_U0: float, eps_z: float) -> tuple[float, float]:
        """Return dalpha (rad) and dK / K of an initial heading error, rad, and a drift, rad/s."""
        return self.mounting_error(phi_U0 - eps_z * (self.t - self.t[0]))

    def noise_sigma(self, gyro_noise: float) -> float:
        """
        Return the yaw error, rad, 1 sigma, of white gyro noise, rad/s/sqrt(Hz).

        sigma^2 = q integral (1 - F)^2 dt, with F the share of the distance driven before t.
        """
        remaining = 1 - (self.s - self.s[0]) / (self.s[-1] - self.s[0])
        a, b = remaining[:-1], remaining[1:]
        return float(gyro_noise * np.sqrt(np.diff(self.t) @ (a * a + a * b + b * b) / 3))

    @property
    def _weight(self) -> Floats:
        ds = np.diff(self.s)
        weight: Floats = ds / ds.sum()
        return weight
