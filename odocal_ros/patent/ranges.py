# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ranges and levels of the search: what is tried about the start values, and why."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.patent.arrays import Design, next_prime_power
from odocal_ros.settings.config import WheelsConfig


@dataclass(frozen=True, eq=False)
class Ranges:
    """
    What is searched about the start values.

    half : (3,) of left and right (relative) and heading (rad).   why : a sentence for each.
    levels : (3,) numbers of levels.
    """

    half: NDArray[np.float64]
    why: tuple[str, str, str]
    levels: tuple[int, int, int]

    def values(self, design: Design) -> Floats:
        """Return x of the rows of an array: equal steps from -half to half."""
        top = np.maximum(np.array(design.levels) - 1, 1)
        return np.where(np.array(design.levels) > 1, (2 * design.rows / top - 1) * self.half, 0.0)

    @property
    def step(self) -> NDArray[np.float64]:
        """Return the step between levels, the whole half range of a single one."""
        step: Floats = 2 * self.half / np.maximum(np.array(self.levels) - 1, 2)
        return step


def ranges_of(wheels: WheelsConfig, heading_sigma: float | None = None) -> Ranges:
    """
    Return the ranges that the settings ask for.

    wheels : ``radius_range``, ``heading_range``, ``levels``.   heading_sigma : of heading and
    mounting angle together, rad, where both are known that well.
    """
    if wheels.radius_range > 0:
        scale, why = wheels.radius_range, 'wheels.radius_range'
    else:
        scale_range = 0.05    # where no error is stated
        scale, why = scale_range, 'no error of the wheels is stated: 5 %'
    if wheels.heading_range > 0:
        heading, reason = wheels.heading_range, 'wheels.heading_range'
    elif heading_sigma:
        heading, reason = min(2 * heading_sigma, np.pi), 'twice the sigma of the heading'
    else:
        heading_range = np.deg2rad(10.0)    # where no error is stated
        heading, reason = heading_range, ('heading and mounting angle rotate the track in the '
                                          'same way, and the angle is unknown: 10 deg')
    # an odd number has zero among its levels
    n = wheels.levels if wheels.levels < 3 else next_prime_power(wheels.levels, odd=True)
    return Ranges(np.array([scale, scale, heading]), (why, why, reason), (n, n, n))
