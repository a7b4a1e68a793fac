# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The parameters of the search, relative change of each wheel's scale and heading, and their ranges.

The interface has those of the patent: x = (left, right, heading), scale = start value (1 + x). The
search uses mean, difference and heading, along which the long valley of the criterion runs: left
plus right moves the track by the distance, their difference by the track width at most.
If the fixes cannot separate left and right, the difference is fixed and two coordinates remain.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.wheel_search.arrays import next_prime_power
from odocal_ros.calib.wheel_search.planar import PlanarLeg
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.settings.config import WheelsConfig

NAMES = ('left', 'right', 'heading')
# definition: columns mean, difference (right minus left), heading; held: mean, heading
FREE = np.array([[1.0, -0.5, 0.0], [1.0, 0.5, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Space:
    """Linear map x = T q from the search coordinates q; held: without the wheel difference."""

    held: bool

    @property
    def T(self) -> Floats:     # noqa: N802
        """Return the matrix of x = T q."""
        return FREE[:, [0, 2]] if self.held else FREE

    @property
    def S(self) -> Floats:     # noqa: N802
        """Return the matrix of v = S q, bounded by the range: x; held: mean and heading."""
        return np.eye(2) if self.held else FREE

    def q_of(self, x: Floats) -> Floats:
        """Return the coordinates q of x; held: without its difference."""
        left, right, heading = x
        mean = (left + right) / 2
        return np.array([mean, heading] if self.held else [mean, right - left, heading])

    def bounds(self, half: Floats) -> Floats:
        """Return the half range of v from that of x: (n,)."""
        return np.array([min(half[:2]), half[2]]) if self.held else np.array(half)

    def widened(self, half: Floats, on_edge: Bools) -> Floats:
        """Return the half range of x, doubled where v is on its edge, with positive scales."""
        edge = np.array([on_edge[0], *on_edge]) if self.held else np.asarray(on_edge)
        widest = np.array([0.9, 0.9, 1.5 * np.pi])    # of a half range
        return np.where(edge, np.minimum(2 * np.asarray(half), widest), half)


def sets_of(leg: PlanarLeg, x: Floats) -> Floats:
    """Return parameter sets (scales in m per unit, heading in rad) of (m, 3) x."""
    x = np.atleast_2d(np.asarray(x, dtype=float))
    return np.stack([leg.scale_left * (1 + x[:, 0]), leg.scale_right * (1 + x[:, 1]), x[:, 2]], -1)


@dataclass(frozen=True, eq=False)
class Ranges:
    """Search ranges about the start values."""

    half: Floats               # (3,) of left and right (relative) and heading (rad)
    why: tuple[str, str, str]  # the source of each
    levels: int                # number of levels of each

    def values(self, rows: Ints) -> Floats:
        """Return x of the rows of an array: equal steps from -half to half."""
        if self.levels == 1:
            return np.zeros(rows.shape)
        return (2 * rows / (self.levels - 1) - 1) * self.half

    @property
    def step(self) -> Floats:
        """Return the step between levels; for one or two levels the half range."""
        return 2 * self.half / max(self.levels - 1, 2)


def ranges_of(wheels: WheelsConfig, heading_sigma: float | None = None) -> Ranges:
    """
    Return the ranges by the settings.

    wheels : ``radius_range``, ``heading_range``, ``levels``.   heading_sigma : of heading and
    mounting angle together, rad; None: unknown.
    """
    if wheels.radius_range > 0:
        scale, why = wheels.radius_range, 'wheels.radius_range'
    else:
        scale_range = 0.05    # if no error is stated
        scale, why = scale_range, 'no error of the wheels is stated: 5 %'
    if wheels.heading_range > 0:
        heading, reason = wheels.heading_range, 'wheels.heading_range'
    elif heading_sigma:
        heading, reason = min(2 * heading_sigma, np.pi), 'twice the sigma of the heading'
    else:
        heading_range = np.deg2rad(10.0)    # if no error is stated
        heading, reason = heading_range, ('heading and mounting angle rotate the track in the '
                                          'same way, and the angle is unknown: 10 deg')
    # an odd number has zero among its levels
    n = wheels.levels if wheels.levels < 3 else next_prime_power(wheels.levels, odd=True)
    return Ranges(np.array([scale, scale, heading]), (why, why, reason), n)
