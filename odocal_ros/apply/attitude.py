# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rotations and attitude increments of single samples, with tuples instead of numpy arrays.

Tuples take a tenth of the time of arrays of one row. The conventions are those of
``nav/rotations.py`` and ``nav/strapdown.py``, which do the same for arrays. A vector has three
numbers, a quaternion four (x y z w), a matrix three rows.
"""

from collections.abc import Sequence
import math

from odocal_ros.nav.strapdown import EVEN_RATIO, MIN_INTERVAL

SMALL = 1e-8      # rad; definition: half angle that is equal to its sine in double precision
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]
ZERO = (0.0, 0.0, 0.0)      # definition


def rotation(phi: Sequence[float]) -> Quaternion:
    """Return the unit quaternion of a rotation vector, rad."""
    a, b, c = phi
    half = math.sqrt(a * a + b * b + c * c) / 2
    s = math.sin(half) / half / 2 if half > SMALL else 0.5
    return s * a, s * b, s * c, math.cos(half)


def quaternion_product(q: Sequence[float], r: Sequence[float]) -> Quaternion:
    """Return the product of two quaternions, normalised."""
    (x, y, z, w), (a, b, c, d) = q, r
    i, j, k, re = (w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a,
                   w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c)
    size = math.sqrt(i * i + j * j + k * k + re * re)
    return i / size, j / size, k / size, re / size


def rotation_matrix(q: Sequence[float]) -> Matrix:
    """Return the rotation matrix of a quaternion, which need not be normalised."""
    x, y, z, w = q
    s = 2 / (x * x + y * y + z * z + w * w)
    return ((1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
            (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
            (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)))


def rotate_vector(C: Sequence[Sequence[float]], v: Sequence[float]) -> Vector:
    """Return the product of a matrix and a vector."""
    (a, b, c), (d, e, f), (g, h, i) = C
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return the cross product of two vectors."""
    (x, y, z), (u, v, w) = a, b
    return y * w - z * v, z * u - x * w, x * v - y * u


def add_scaled(a: Vector, b: Vector, times: float = 1.0) -> Vector:
    """Return the sum of a vector and a multiple of another."""
    return a[0] + b[0] * times, a[1] + b[1] * times, a[2] + b[2] * times


def rotation_increment(t: Sequence[float], w: Sequence[Sequence[float]], k: int) -> Vector:
    """
    Return the rotation vector of b from sample k to the next, rad.

    t : s.   w : rad/s.   Bitwise equal to ``nav.strapdown.rotation_increments``: the integral of
    the cubic through four rates, or of the line through two at uneven times, and its coning term.
    """
    h, first, second = t[k + 1] - t[k], w[k], w[k + 1]
    # change of the rate within the interval; with four rates h times its slope in the middle
    rise = [b - a for a, b in zip(first, second, strict=True)]
    middle = [(a + b) * 0.5 for a, b in zip(first, second, strict=True)]      # rate at h / 2
    angle = [m * h for m in middle]
    if 0 < k < len(t) - 2:
        before, between = max(t[k] - t[k - 1], MIN_INTERVAL), max(h, MIN_INTERVAL)
        after = max(t[k + 2] - t[k + 1], MIN_INTERVAL)
        if (max(before, after) < EVEN_RATIO * between
                and between < EVEN_RATIO * min(before, after)):
            weight = between * between / 4 / (before + between + after)
            left_weight = weight * (between / 2 + after)
            right_weight = weight * (between / 2 + before)
            for i, (a, b, c, d) in enumerate(zip(w[k - 1], first, second, w[k + 2], strict=True)):
                slope = rise[i] / between
                # curvatures as second divided differences; sag: line minus cubic in the middle;
                # its mean over the interval is 2/3 of that
                left = (slope - (b - a) / before) / (before + between)
                right = ((d - c) / after - slope) / (between + after)
                sag = left * left_weight + right * right_weight
                middle[i] -= sag
                rise[i] -= (right - left) * (weight * between)
                angle[i] -= sag * (h * (2 / 3))
    coning, h2 = cross(middle, rise), h * h / 12
    return angle[0] + coning[0] * h2, angle[1] + coning[1] * h2, angle[2] + coning[2] * h2
