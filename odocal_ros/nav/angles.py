# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles: wrapping, and conversion of heading (from north, clockwise) and yaw (from east, ccw)."""

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import Floats


def wrap(angle: ArrayLike) -> Floats:
    """Wrap an angle to (-pi, pi]; an angle in this range is returned unchanged."""
    angle = np.asarray(angle, dtype=float)
    wrapped = np.pi - (np.pi - angle) % (2 * np.pi)
    wrapped = np.where(wrapped > -np.pi, wrapped, np.pi)     # the remainder may round to 2 pi
    return np.where((angle > -np.pi) & (angle <= np.pi), angle, wrapped)[()]


def arctan2(y: ArrayLike, x: ArrayLike) -> Floats:
    """
    Return np.arctan2, independent of the memory layout of the arguments.

    numpy 1.26 (Jazzy) rounds the result for columns of a matrix depending on their addresses: live
    and replay would differ in the last digits.
    """
    return np.arctan2(np.copy(y), np.copy(x))


def yaw_from_heading(heading: float | Floats) -> Floats:
    """Convert compass heading to ENU yaw, rad."""
    return wrap(np.pi / 2 - heading)


def heading_from_yaw(yaw: ArrayLike) -> Floats:
    """Convert ENU yaw to compass heading, rad, in [0, 2 pi)."""
    heading = (np.pi / 2 - np.asarray(yaw, dtype=float)) % (2 * np.pi)
    return np.where(heading < 2 * np.pi, heading, 0.0)[()]   # the remainder may round to 2 pi
