# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The input of the estimator: one leg as arrays of screened samples (``SmootherLeg``)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import C_en
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import arctan2, transpose
from odocal_ros.screening.inputs import Inputs

# s, judgement: a standstill that ended earlier than this before the start mark is not used
BEFORE_MARK = 30.0
# Hz, limit for velocity and heading. Physical: their errors last longer than a fifth of a second
EXTERNAL_RATE = 5.0
# Hz, limit for fixes. Judgement, measured in decision 21: the rows of fixes do not contain the
# noise of the IMU between a fix and its keyframe; denser and more accurate fixes make the fit
# oscillate
FIX_RATE = 20.0


@dataclass(frozen=True, eq=False)
class ExternalSamples:
    """Samples of a sensor: arrays of one length. A subclass adds their d values."""

    t: Floats       # (m,) s since the start mark
    sigma: Floats   # (m,) or (m, d), of the white noise

    def between(self, first: float, last: float) -> Self:
        """Return the samples between two times."""
        inside = (self.t >= first) & (self.t <= last)
        return replace(self, **{name: column[inside] for name, column in vars(self).items()
                                if isinstance(column, np.ndarray)})


def thinning(t: Floats, max_rate: float = EXTERNAL_RATE) -> slice:
    """Return a slice that thins sorted times, s, to a rate of about ``max_rate``, Hz."""
    rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9) if len(t) else 0.0
    return slice(None, None, max(1, round(rate / max_rate)))


def enu_to_n(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return C_np at times t, p: east, north, up at the vehicle: (m, 3, 3)."""
    latitude, longitude = (np.interp(t, inputs.t_fix, inputs.geodetic[:, i]) for i in (0, 1))
    return transpose(C_en(origin.latitude, origin.longitude)) @ C_en(latitude, longitude)


def meridian_convergence(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return the meridian convergence, the yaw in n of east at the vehicle: (m,) rad."""
    C_np = enu_to_n(inputs, t, origin)
    return arctan2(C_np[:, 1, 0], C_np[:, 0, 0])


@dataclass(frozen=True, eq=False)
class SmootherLeg:
    """
    One leg: times in s since the start mark; b the axes of the IMU, n fixed at ``origin``.

    Lever arms are positions in base_link axes, m. Fixes without a height have NaN up.
    """

    origin: Origin
    t_begin: float              # s, start of the used data: the mark or a standstill before it
    t_stop: float               # s, end of the used data
    t_imu: Floats               # (n,) s
    w_b: Floats                 # (n, 3) rad/s
    f_b: Floats                 # (n, 3) m/s^2
    travel: Travel
    t_fix: Floats               # (k,) s
    fixes_n: Floats             # (k, 3) m
    covariance_n: Floats        # (k, 3, 3) m^2, stated by the receiver, plus rounding
    standstills: Floats         # (s, 2) s, start and end
    rough_scale: float          # metres per unit of travel, with an error of up to 30 %
    nominal_scale: float = 0.0  # K0, 0 unknown
    scale_unit: str = 'm/pulse'
    imu_arm: Floats = field(default_factory=lambda: np.zeros(3))
    odometer_arm: Floats = field(default_factory=lambda: np.zeros(3))
    antenna_arm: Floats = field(default_factory=lambda: np.zeros(3))
    # times, s, and sigmas, scale units, of steps of the travel that are uncertain: slips, gaps
    uncertain_t: Floats = field(default_factory=lambda: np.empty(0))
    uncertain_sigma: Floats = field(default_factory=lambda: np.empty(0))
    # other sensors, by the name of their factor
    external: Mapping[str, ExternalSamples] = field(default_factory=dict)
    wheels: tuple[Travel, ...] = ()     # single wheels, in the order of odometer.wheels
    has_accelerometer: bool = True      # False: f_b is constant gravity
    # (k, 3) or (1, 3) m^2, part of ``covariance_n`` from rounding of the positions
    rounding_n: Floats = field(default_factory=lambda: np.zeros((1, 3)))

    @property
    def stated_sigma(self) -> Floats:
        """Return the sigmas that the receiver states: (k, 3) m."""
        variance = self.covariance_n.diagonal(axis1=1, axis2=2) - self.rounding_n
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def uses_speed_steps(self) -> bool:
        """
        Return True if only the step transitions of a coarse speed are used, not its integral.

        The integral of a speed rounded to 0.05 m/s has an error of at most 1.5 m in a minute.
        """
        coarse = self.travel.coarse
        return coarse is not None and coarse.step * self.rough_scale > 0.05


def drift_time(leg: SmootherLeg, t: Floats) -> Floats:
    """
    Return the time in which the correlated error of fixes changes in each interval: (N - 1,) s.

    The error of GNSS changes with time: the length of the interval. That of positions in a local
    frame (drift of SLAM, cells and particles of AMCL) changes with the path of the wheels: the
    length of the leg, divided in proportion to the path.
    """
    T = np.diff(t)
    max_robot_speed = 5.0       # m/s, judgement: indoors; the positions of a car are from GNSS
    distance = np.abs(np.diff(leg.travel.at(t))) * leg.rough_scale
    if not leg.origin.is_local or (distance > max_robot_speed * T).any():
        return T
    path = np.max([np.abs(np.diff(x.at(t))) for x in leg.wheels or (leg.travel,)], axis=0)
    rest_share = 0.01   # of the time, judgement: a pose may change without motion
    out: Floats = np.maximum(T.sum() * path / max(path.sum(), 1e-12), rest_share * T)
    return out
