# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
External observations besides fixes: velocity of the antenna, heading of the IMU's x axis.

A heading comes with one error for the whole leg (a mounting, a declination, a compass), which no
number of messages averages out, and white noise; a heading configured at the start mark is one
such message.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.nav.alignment import HEADING_LIMIT
from odocal_ros.nav.angles import arctan2, wrap, yaw_from_heading
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.earth import C_en
from odocal_ros.nav.rotations import matrix_from_quat, transpose
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config, GnssConfig

Floats = NDArray[np.float64]
VELOCITY_SIGMA = 0.1        # m/s, initial if a receiver states none: physical, Doppler
# of a GNSS velocity, s and s^2, 1 sigma: physical, receivers are late by up to 0.25 s and smooth
# over as much
VELOCITY_TIME_SIGMA, VELOCITY_LAG2_SIGMA = 0.25, 0.1
# Hz: physical, errors of velocity and heading last longer than a fifth of a second
OUTSIDE_RATE = 5.0
GIVEN_HEADING_NOISE = 1e-4  # rad, of a heading given at the mark, beside its error: next to none


def _none(*shape: int) -> Any:
    return field(default_factory=lambda: np.empty((0, *shape)))


@dataclass(frozen=True, eq=False)
class Velocity:
    """Horizontal velocity of the antenna, in n: (m,) s, (m, 2) m/s."""

    t: Floats = _none()
    velocity_n: Floats = _none(2)
    sigma: Floats = _none(2)

    def between(self, first: float, last: float) -> 'Velocity':
        """Return the rows between two times."""
        pick = (self.t >= first) & (self.t <= last)
        return Velocity(self.t[pick], self.velocity_n[pick], self.sigma[pick])


@dataclass(frozen=True, eq=False)
class Heading:
    """
    Yaw of the IMU's x axis in n: (m,) s, (m,) rad.

    noise : (m,) rad.   sigma : rad, of the error that is the same through the leg.
    """

    t: Floats = _none()
    yaw: Floats = _none()
    noise: Floats = _none()
    sigma: float = 1.0
    source: str = ''

    def between(self, first: float, last: float) -> 'Heading':
        """Return the rows between two times."""
        pick = (self.t >= first) & (self.t <= last)
        return Heading(self.t[pick], self.yaw[pick], self.noise[pick], self.sigma, self.source)


def outside_velocity(inputs: Inputs, config: Config, origin: Origin) -> Velocity:
    """Return the velocity of the antenna, in n; empty: not used."""
    # without an accelerometer its change between keyframes is unknown
    if not (config.gnss.use_velocity and len(inputs.t_velocity) and inputs.felt):
        return Velocity()
    some = _thinned(inputs.t_velocity)
    t, variance = inputs.t_velocity[some], inputs.velocity_variance[some, :2]
    known = np.isfinite(variance) & (variance > 0)
    sigma = np.sqrt(np.where(known, variance, VELOCITY_SIGMA**2))
    v_n = (_from_place(inputs, t, origin) @ inputs.velocity_n[some, :, None])[:, :2, 0]
    return Velocity(t, v_n, sigma)


def velocity_sigmas(gnss: GnssConfig) -> Floats:
    """Return the prior sigmas of the constants VELOCITY: (3,)."""
    return np.array([np.hypot(VELOCITY_TIME_SIGMA, gnss.time_sigma), VELOCITY_LAG2_SIGMA,
                     max(gnss.velocity_scale_sigma, 1e-6)])


def outside_heading(inputs: Inputs, config: Config, origin: Origin) -> Heading:
    """Return the configured heading, else that of the heading topic; empty: none."""
    asked, alignment = config.alignment.heading_source, config.alignment
    given = not np.isnan(alignment.heading)
    if given and asked in ('auto', 'fixed'):
        yaw = yaw_from_heading(alignment.heading) + _convergence(inputs, np.zeros(1), origin)
        return Heading(np.zeros(1), wrap(yaw), np.full(1, GIVEN_HEADING_NOISE),
                       alignment.heading_sigma, 'fixed')
    if asked in ('auto', 'heading_topic'):
        return _sent(inputs, inputs.t_heading, inputs.q_heading, inputs.heading_variance,
                     alignment.heading_offset, config, origin, np.eye(3), 'heading_topic')
    if asked == 'imu_orientation':
        return _sent(inputs, inputs.t_imu, inputs.q_ni, inputs.yaw_variance, 0.0, config, origin,
                     transpose(inputs.C_bi), 'imu_orientation')
    return Heading()


def _sent(inputs: Inputs, t: Floats, q: Floats, variance: Floats, offset: float, config: Config,
          origin: Origin, C_ib: Floats, source: str) -> Heading:
    """Return the heading of orientations q (m, 4) that an IMU or a topic publishes."""
    good = ~np.isnan(variance) & (np.linalg.norm(q, axis=-1) > 0.5)
    t, q, variance = t[good], q[good], variance[good]
    if len(t) < 2 or not len(inputs.t_fix):
        return Heading()
    some = _thinned(t)
    t, q, variance = t[some], q[some], variance[some]
    stated = float(np.median(variance))
    sigma = np.sqrt(stated) if stated > 0 else config.alignment.heading_sigma
    if sigma > HEADING_LIMIT:
        return Heading()
    C = matrix_from_quat(q) @ C_ib
    yaw = arctan2(C[:, 1, 0], C[:, 0, 0]) + offset + _convergence(inputs, t, origin)
    return Heading(t, wrap(yaw), np.full(len(t), sigma), float(max(sigma, 1e-5)), source)


def _thinned(t: Floats) -> slice:
    """Return an index that thins sorted times to about OUTSIDE_RATE."""
    rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
    return slice(None, None, max(1, round(rate / OUTSIDE_RATE)))


def _from_place(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return C_np of the places at times: east and north differ from those at the origin."""
    latitude, longitude = (np.interp(t, inputs.t_fix, inputs.geodetic[:, i]) for i in (0, 1))
    return transpose(C_en(origin.latitude, origin.longitude)) @ C_en(latitude, longitude)


def _convergence(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return the yaw in n of east at the places of the vehicle: (m,) rad."""
    C_np = _from_place(inputs, t, origin)
    return arctan2(C_np[:, 1, 0], C_np[:, 0, 0])
