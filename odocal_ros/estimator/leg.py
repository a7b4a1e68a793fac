# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The input of the estimator: one leg as screened arrays."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.estimator.outside import Heading, outside_heading, outside_velocity, Velocity
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.odometer import Travel
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import nominal_scale

Floats = NDArray[np.float64]
# s: a standstill that ended longer before the start mark is another drive. Judgement
BEFORE_MARK = 30.0


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
    covariance_n: Floats        # (k, 3, 3) m^2
    standstills: Floats         # (s, 2) s
    rough_scale: float          # metres per unit of travel, good to 30 %
    nominal_scale: float = 0.0  # K0, 0 unknown
    scale_unit: str = 'm/pulse'
    imu_arm: Floats = field(default_factory=lambda: np.zeros(3))
    odometer_arm: Floats = field(default_factory=lambda: np.zeros(3))
    antenna_arm: Floats = field(default_factory=lambda: np.zeros(3))
    doubt_t: Floats = _none()
    doubt_sigma: Floats = _none()        # scale units
    velocity: Velocity = Velocity()
    heading: Heading = Heading()
    wheels: tuple[Travel, ...] = ()     # in the order of odometer.wheels
    felt: bool = True                   # False: no accelerometer, f_b is gravity, made up

    @property
    def by_steps(self) -> bool:
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
    at_rest = 0.01      # of the time, judgement: a pose may change without motion
    out: Floats = np.maximum(T.sum() * path / max(path.sum(), 1e-12), at_rest * T)
    return out


def smoother_leg(inputs: Inputs, config: Config, origin: Origin, fixes_n: Floats, spans: Floats,
                 rough_scale: float, t_stop: float | None = None) -> SmootherLeg:
    """
    Return the smoother's view of screened inputs.

    inputs : of ``screen``.   config : lever arms, nominal scale.   origin, fixes_n : Origin, (k,
    3) where n is fixed and the fixes in it, m; NaN up where a fix has no height.   spans : (s, 2)
    standstills, s.   rough_scale : metres per unit of travel.   t_stop : end of what is used, s (a
    held-out rest); the stop mark by default.
    """
    t_stop = inputs.t_stop if t_stop is None else t_stop
    if not inputs.felt:         # the ground is taken as level, so heights have no say
        fixes_n = fixes_n * np.array([1.0, 1.0, np.nan])
    before = [s for s in spans if s[0] <= 0.5 and s[1] >= -BEFORE_MARK]
    t_begin = min(0.0, float(before[-1][0])) if before else 0.0
    return SmootherLeg(
        origin=origin, t_begin=t_begin, t_stop=float(t_stop), t_imu=inputs.t_imu,
        w_b=inputs.w_b, f_b=inputs.f_b, travel=inputs.travel, t_fix=inputs.t_fix,
        fixes_n=fixes_n, covariance_n=inputs.covariance_n, standstills=np.asarray(spans),
        rough_scale=float(rough_scale), nominal_scale=nominal_scale(config, inputs.scale_unit),
        scale_unit=inputs.scale_unit, imu_arm=np.array(config.imu.lever_arm, float),
        odometer_arm=np.array(config.odometer.lever_arm, float),
        antenna_arm=np.array(config.gnss.lever_arm, float),
        doubt_t=inputs.doubt_t, doubt_sigma=inputs.doubt_sigma,
        velocity=outside_velocity(inputs, config, origin),
        heading=outside_heading(inputs, config, origin), felt=inputs.felt,
        wheels=inputs.travels)
