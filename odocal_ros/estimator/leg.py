# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The input of the estimator: one leg as screened arrays, with observations besides fixes."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import C_en
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import arctan2, transpose
from odocal_ros.screening.inputs import Inputs

# s: a standstill that ended longer before the start mark is another drive. Judgement
BEFORE_MARK = 30.0
# Hz: physical, errors of velocity and heading last longer than a fifth of a second
EXTERNAL_RATE = 5.0
# Hz: judgement, measured in decision 21. The noise of the IMU between a fix and its keyframe is
# not in the rows of fixes; denser ones, finer than this noise, make the fit oscillate
FIX_RATE = 20.0


@dataclass(frozen=True, eq=False)
class ExternalSamples:
    """Rows of a sensor in frame n: arrays of one length, times first."""

    t: Floats       # (m,) s

    def between(self, first: float, last: float) -> Self:
        """Return the rows between two times."""
        pick = (self.t >= first) & (self.t <= last)
        columns = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(self, **{name: column[pick] for name, column in columns.items()
                                if isinstance(column, np.ndarray)})


def thinned(t: Floats, most: float = EXTERNAL_RATE) -> slice:
    """Return an index that thins sorted times, s, to a rate of about ``most``, Hz."""
    rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9) if len(t) else 0.0
    return slice(None, None, max(1, round(rate / most)))


def enu_to_n(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return C_np of the places at times: east and north differ from those at the origin."""
    latitude, longitude = (np.interp(t, inputs.t_fix, inputs.geodetic[:, i]) for i in (0, 1))
    return transpose(C_en(origin.latitude, origin.longitude)) @ C_en(latitude, longitude)


def convergence(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return the yaw in n of east at the places of the vehicle: (m,) rad."""
    C_np = enu_to_n(inputs, t, origin)
    return arctan2(C_np[:, 1, 0], C_np[:, 0, 0])


def _none(*shape: int) -> Any:
    return field(default_factory=lambda: np.empty((0, *shape)))


@dataclass(frozen=True, eq=False)
class SmootherLeg:
    """
    One leg, screened: times in s since the start mark, SI, body frame b, n fixed at ``origin``.

    Lever arms are positions in base_link axes, m. Fixes without a height have NaN up.
    """

    origin: Origin
    t_begin: float              # s, first moment used: the standstill before the mark, or the mark
    t_stop: float               # s
    t_imu: Floats               # (n,)
    w_b: Floats                 # (n, 3) rad/s
    f_b: Floats                 # (n, 3) m/s^2
    travel: Travel
    t_fix: Floats               # (k,)
    fixes_n: Floats             # (k, 3) m
    covariance_n: Floats        # (k, 3, 3) m^2, with rounding
    standstills: Floats         # (s, 2) s
    rough_scale: float          # metres per unit of travel, good to 30 %
    nominal_scale: float = 0.0  # K0, 0 unknown
    scale_unit: str = 'm/pulse'
    imu_arm: Floats = field(default_factory=lambda: np.zeros(3))
    odometer_arm: Floats = field(default_factory=lambda: np.zeros(3))
    antenna_arm: Floats = field(default_factory=lambda: np.zeros(3))
    uncertain_t: Floats = _none()
    uncertain_sigma: Floats = _none()        # scale units
    # by the name of the factor
    external: Mapping[str, ExternalSamples] = field(default_factory=dict)
    wheels: tuple[Travel, ...] = ()     # in the order of odometer.wheels
    has_accelerometer: bool = True      # False: f_b is constant gravity
    # (k, 3) or (1, 3) m^2, part of the variances of the fixes by rounding
    rounding_n: Floats = field(default_factory=lambda: np.zeros((1, 3)))

    @property
    def stated_sigma(self) -> Floats:
        """Return the sigmas that the receiver states: (k, 3) m."""
        variance = self.covariance_n.diagonal(axis1=1, axis2=2) - self.rounding_n
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def uses_speed_steps(self) -> bool:
        """
        Return True if the transitions of a coarse speed are used, not its integral.

        A speed in steps of less than 0.05 m/s is integrated, with rounding noise: a minute at
        constant speed is then at most 1 m off.
        """
        coarse = self.travel.coarse
        return coarse is not None and coarse.step * self.rough_scale > 0.05


def drift_time(leg: SmootherLeg, t: Floats) -> Floats:
    """
    Return the time in which the correlated error of fixes changes between keyframes: (N - 1,) s.

    That of GNSS changes with time. That of positions in a local frame (drift of SLAM, cells and
    particles of AMCL) changes with the path of the wheels: time is shared out by path.
    """
    T = np.diff(t)
    fastest = 5.0       # m/s, judgement: no robot indoors; the positions of a car are from GNSS
    far = np.abs(np.diff(leg.travel.at(t))) * leg.rough_scale
    if not leg.origin.local or (far > fastest * T).any():
        return T
    path = np.max([np.abs(np.diff(one.at(t))) for one in leg.wheels or (leg.travel,)], axis=0)
    at_rest = 0.01      # share of the time, judgement: a pose may change without motion
    out: Floats = np.maximum(T.sum() * path / max(path.sum(), 1e-12), at_rest * T)
    return out
