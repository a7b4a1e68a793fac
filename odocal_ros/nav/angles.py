# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles: wrapping, and heading (from north, clockwise) against yaw (from east, ccw)."""

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import Floats


def wrap(angle: ArrayLike) -> Floats:
    """Bring an angle into (-pi, pi]; one that is there already keeps every bit."""
    angle = np.asarray(angle, dtype=float)
    wrapped = np.pi - (np.pi - angle) % (2 * np.pi)
    wrapped = np.where(wrapped > -np.pi, wrapped, np.pi)     # the remainder may round to 2 pi
    return np.where((angle > -np.pi) & (angle <= np.pi), angle, wrapped)[()]


def arctan2(y: ArrayLike, x: ArrayLike) -> Floats:
    """
    Return np.arctan2, the same wherever the values lie in memory.

    numpy 1.26, which Jazzy has, rounds that of columns of a matrix by their addresses: live and
    replay would differ in the last digits.
    """
    return np.arctan2(np.copy(y), np.copy(x))


def yaw_from_heading(heading: float | Floats) -> Floats:
    """Turn compass heading into ENU yaw, rad."""
    return wrap(np.pi / 2 - heading)


def heading_from_yaw(yaw: ArrayLike) -> Floats:
    """Turn ENU yaw into compass heading, rad, in [0, 2 pi)."""
    heading = (np.pi / 2 - np.asarray(yaw, dtype=float)) % (2 * np.pi)
    return np.where(heading < 2 * np.pi, heading, 0.0)[()]   # the remainder may round to 2 pi
