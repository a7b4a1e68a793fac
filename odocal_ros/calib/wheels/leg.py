# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the wheels are calibrated on: one leg, its two wheels' tracks, its fixes."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.marks import MarkFix
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.dead_reckoning import forward_b, Origin, Track

Events = tuple[NDArray[np.float64], NDArray[np.float64]]


def _none() -> Events:
    return np.empty(0), np.empty(0)


@dataclass(frozen=True, eq=False)
class WheelLeg:
    """
    A leg with two wheels, aligned and dead reckoned.

    origin : where n is fixed.        left, right : tracks of either wheel, of the same epochs.
    quantum : size of a count, scale units; 0 for angles and speeds.
    interval : s, between odometer rows.
    t_fix : (k,) s.  fixes_n : (k, 3) m, NaN up where unknown.  covariance_n : (k, 3, 3) m^2.
    start : reference position at the start mark.
    t_start, t_stop : s, range of the fixes used; later ones are held out.
    alignment : heading, level and gyro bias the tracks began with, and their sigmas.
    lever_b : (3,) m, antenna from the odometer's point, in v.
    nominal, rough : scale of the mean of both counts as configured (0: unknown), and by fixes.
    doubt : (t, sigma) s, scale units of the mean: travel lost in gaps and resets.
    slips : (t, size) s, m: what an Imu saw the wheels spin.
    uneven : a wheel fails, or the ratio of both changes on the way, as was said already.
    """

    origin: Origin
    left: Track
    right: Track
    quantum: float
    t_fix: NDArray[np.float64]
    fixes_n: NDArray[np.float64]
    covariance_n: NDArray[np.float64]
    start: MarkFix
    t_start: float
    t_stop: float
    alignment: Alignment
    lever_b: NDArray[np.float64]
    nominal: float
    rough: float
    scale_unit: str
    interval: float = 0.05
    doubt: Events = field(default_factory=_none)
    slips: Events = field(default_factory=_none)
    uneven: bool = False


def positions(leg: WheelLeg, t: Floats, k_left: float, k_right: float, heading_error: float,
              pitch: float = 0.0) -> Floats:
    """
    Return antenna positions of the corrected track, n, m: (n,) times to (n, 3).

    Parameters
    ----------
    leg : WheelLeg
        Tracks; the start mark is where the track is pinned.
    t : (n,) array
        Times, s.
    k_left, k_right : float
        Scale of each wheel, m per unit.
    heading_error : float
        What the heading is to be turned by, counter-clockwise from above, rad: error of the
        alignment and mounting angle together.
    pitch : float
        Pitch mounting angle, rad.

    """
    d_b = forward_b(-heading_error, pitch)
    way = ((leg.left.at(t) - leg.left.at(leg.start.t)) @ d_b * k_left
           + (leg.right.at(t) - leg.right.at(leg.start.t)) @ d_b * k_right) / 2
    turn = leg.left.C_nb_at(t) - leg.left.C_nb_at(np.array(leg.start.t))
    return leg.start.position_n + way + turn @ (C_bv(heading_error, pitch) @ leg.lever_b)


def C_bv(heading_error: float, pitch: float) -> Floats:
    """Return the rotation that takes v to b for a heading error and a pitch, roll 0, (3, 3)."""
    x = forward_b(-heading_error, pitch)
    y = np.array([-np.cos(pitch) * np.sin(heading_error), np.cos(heading_error),
                  -np.sin(pitch) * np.sin(heading_error)])
    return np.stack([x, y, np.cross(x, y)], -1)


def wheel_factors(scale: float, log_ratio: float) -> tuple[float, float]:
    """
    Return the left and the right factor, m per unit: docs/method.md (W1).

    scale : of the mean of both counts on a straight way, the harmonic mean of the two.
    log_ratio : ln(right / left).
    """
    ratio = np.exp(log_ratio)
    left = scale * (1 + 1 / ratio) / 2
    return float(left), float(left * ratio)
