# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Attitude of one sample after another, in plain numbers: arrays of one row cost ten times as much.

The conventions are those of ``nav/rotations.py``, which does the same for arrays.
"""

import math

import numpy as np

from odocal_ros.data.arrays import Floats

SMALL = 1e-8      # rad; definition: a half angle whose sine is the angle to the last digit


def turned(q: Floats, phi: Floats) -> Floats:
    """Return a quaternion, x y z w, turned by a rotation vector of its own axes, rad; unit."""
    a, b, c = phi.tolist()
    half = math.sqrt(a * a + b * b + c * c) / 2
    s = math.sin(half) / half / 2 if half > SMALL else 0.5
    return product(q, (s * a, s * b, s * c, math.cos(half)))


def product(q: Floats, r: Floats | tuple[float, ...]) -> Floats:
    """Return the product of two quaternions, of length 1."""
    (x, y, z, w), (a, b, c, d) = q.tolist(), r
    out = (w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a,
           w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c)
    size = math.sqrt(sum(value * value for value in out))
    return np.array([value / size for value in out])


def matrix_of(q: Floats) -> Floats:
    """Return the rotation matrix of a quaternion of any length but zero, (3, 3)."""
    x, y, z, w = q.tolist()
    s = 2 / (x * x + y * y + z * z + w * w)
    return np.array([[1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
                     [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
                     [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)]])


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product of two vectors, (3,)."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def skewed(a: Floats) -> Floats:
    """Return the matrix of the cross product with a vector, (3, 3)."""
    x, y, z = a.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
