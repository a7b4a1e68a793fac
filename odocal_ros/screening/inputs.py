# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Inputs of the methods: screened rows of a leg, fixes in metres, approximate scale."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, medians
from odocal_ros.nav import geodesy
from odocal_ros.nav.dead_reckoning import Origin, rough_scale
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.standstill import standstills
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import nominal_scale

# judgement: a receiver that states 0.5 m can drift by 20 m at rest, and one with RTK by 0.5 m;
# four lengths of certain motion fit in the extent of a drive
MOTION_SIGMAS, EXTENT_PER_MOTION = 40.0, 4.0


class UsableRows(NamedTuple):
    """The usable rows of a topic, as sent, and their times from the start mark: (n,) s."""

    samples: Any
    t: Floats


class ImuRows(NamedTuple):
    """Rows of an IMU, with its biases."""

    t: Floats      # (n,) s
    w_b: Floats    # (n, 3) rad/s
    f_b: Floats    # (n, 3) m/s^2


@dataclass(frozen=True, eq=False)
class Inputs:
    """
    A screened leg in SI units, with rising times since the start mark.

    b : axes of the IMU after its nominal mounting rotation; i : axes of the IMU messages.
    """

    t_stop: float                      # s, the stop mark
    t_imu: NDArray[np.float64]         # (n,)
    w_b: NDArray[np.float64]           # (n, 3) rad/s
    f_b: NDArray[np.float64]           # (n, 3) m/s^2
    q_ni: NDArray[np.float64]          # (n, 4) published orientation, i to n
    yaw_variance: NDArray[np.float64]  # (n,) rad^2, NaN: no orientation
    C_bi: NDArray[np.float64]          # (3, 3) nominal mounting, i to b
    travel: Travel                     # mean of the wheels
    travels: tuple[Travel, ...]        # of several wheels; () if one, or if sides are unknown
    uncertain_t: NDArray[np.float64]       # (d,) s, times of uncertain travel (resets, gaps)
    uncertain_sigma: NDArray[np.float64]   # (d,) its sigma, scale units
    t_fix: NDArray[np.float64]         # (k,)
    geodetic: NDArray[np.float64]      # (k, 3) latitude, longitude rad, height m (NaN: none)
    covariance_n: NDArray[np.float64]  # (k, 3, 3) m^2
    rounding_n: NDArray[np.float64]    # (k, 3) m^2, part of these variances by rounding
    external: Mapping[str, UsableRows]     # heading, fix velocity, pressure ..., by slot
    fixes_rejected: int
    scale_unit: str
    has_accelerometer: bool = True     # False: f_b is assumed gravity
    is_local: bool = False             # True: fixes are positions in a local frame
    # corrected delays of clocks seconds from the IMU's, by group of settings: s, > 0 late
    clock_delays: Mapping[str, float] = field(default_factory=dict)
    # stamps ahead of IMU stamps of the same arrival, by topic, beyond the limit: s
    clock_differences: Mapping[str, float] = field(default_factory=dict)

    @property
    def imu(self) -> ImuRows:
        return ImuRows(self.t_imu, self.w_b, self.f_b)

    @cached_property
    def median_f_b(self) -> Floats:
        """Return the median of the specific force, which points up: (3,) m/s^2."""
        return medians(self.f_b)

    @property
    def up_b(self) -> Floats:
        """Return the direction of the median specific force: (3,) unit vector, 0 without force."""
        return self.median_f_b / max(float(np.linalg.norm(self.median_f_b)), 1e-9)

    @cached_property
    def min_motion(self) -> float:
        """Return the minimum distance between positions that is certainly motion, m."""
        if self.is_local or not len(self.t_fix):
            return geodesy.MIN_LOCAL_MOTION if self.is_local else geodesy.MIN_GNSS_MOTION
        # an accurate receiver shows the motion of a robot on a lawn of a few metres
        sigma = _horizontal_sigma(self.covariance_n)
        horizontal = median_origin(self.t_fix, self.geodetic).to_n(
            np.nan_to_num(self.geodetic))[:, :2]
        extent = float(np.hypot(*np.ptp(np.quantile(horizontal, [0.01, 0.99], axis=0), axis=0)))
        return float(np.clip(extent / EXTENT_PER_MOTION, max(
            geodesy.MIN_LOCAL_MOTION, MOTION_SIGMAS * sigma), geodesy.MIN_GNSS_MOTION))

    def standstills(self, metres_per_unit: float, config: Config) -> Floats:
        """Return the standstills of ``leg.standstill`` or longer, begin and end: (k, 2) s."""
        return standstills(self.t_imu, self.w_b, self.travel, metres_per_unit,
                           config.leg.standstill)

    def mirrored(self, spans: Floats) -> 'Inputs':
        """Return the inputs with the counts in spans, (m, 2) s, reversed."""
        if not len(spans):
            return self
        return replace(self, travel=self.travel.mirrored(spans),
                       travels=tuple(travel.mirrored(spans) for travel in self.travels))


@dataclass(frozen=True, eq=False)
class LocatedFixes:
    """The fixes in the Cartesian frame n, and the approximate scale of the odometer."""

    origin: Origin                     # of n
    fixes_n: NDArray[np.float64]       # (k, 3) m, NaN up if a fix has no height
    fix_sigma: float                   # m, median 1 sigma of a horizontal axis, NaN: no fixes
    nominal_scale: float               # K0, metres per unit of travel, 0: unknown
    rough_scale: float                 # by the fixes, to some per cent; K0 if they hardly move


def locate_fixes(inputs: Inputs, config: Config) -> LocatedFixes:
    """Return the fixes in n, from ``median_origin``, and the approximate scale."""
    nominal = nominal_scale(config, inputs.scale_unit)
    if not len(inputs.t_fix):
        return LocatedFixes(Origin(0.0, 0.0, 0.0), np.empty((0, 3)), np.nan, nominal, nominal)
    origin = median_origin(inputs.t_fix, inputs.geodetic)
    if inputs.is_local:
        latitude = np.deg2rad(config.reference.latitude_deg)
        origin = replace(origin, local_earth_rate=geodesy.rate_without_north(float(latitude)))
    geodetic = inputs.geodetic.copy()
    no_height = np.isnan(geodetic[:, 2])
    geodetic[no_height, 2] = origin.height
    fixes_n = origin.to_n(geodetic)
    fixes_n[no_height, 2] = np.nan
    sigma = _horizontal_sigma(inputs.covariance_n)
    rough = rough_scale(inputs.travel, inputs.t_fix, fixes_n, sigma,
                        inputs.min_motion) or nominal
    return LocatedFixes(origin, fixes_n, sigma, nominal, rough)


def _horizontal_sigma(covariance_n: Floats) -> float:
    """Return the median 1 sigma of a horizontal axis of fixes, m; covariance_n : (k, 3, 3) m^2."""
    return float(np.sqrt(np.median(covariance_n[:, 0, 0])))


def median_origin(t_fix: Floats, geodetic: Floats) -> Origin:
    """
    Return the origin of n: the median of the fixes near the start, so it is not an outlier.

    t_fix : (k,) s since the start mark.   geodetic : (k, 3) latitude, longitude, rad, height, m.
    """
    fixes_at_start = 11    # judgement: nearest to the start mark
    rows = np.sort(np.argsort(np.abs(t_fix), kind='stable')[:fixes_at_start])
    r_e = geodesy.ecef_from_geodetic(geodetic[rows, 0], geodetic[rows, 1], 0.0)
    central = rows[np.argmin(np.linalg.norm(r_e - np.median(r_e, axis=0), axis=1))]
    latitude, longitude, height = geodetic[central].tolist()
    heights = geodetic[~np.isnan(geodetic[:, 2]), 2] if np.isnan(height) else [height]
    return Origin(latitude, longitude, float(np.median(heights)) if len(heights) else 0.0)
