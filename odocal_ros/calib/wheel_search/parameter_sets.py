# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Parameter sets of the search: orthogonal arrays of levels, their ranges, and search coordinates.

The parameters are the relative change of each wheel's scale, and the heading. The interface has
those of the patent: x = (left, right, heading), scale = start value (1 + x). The search uses mean,
difference and heading, along which the long valley of the criterion runs: left plus right moves
the track by the distance, their difference by the track width at most. If the fixes cannot
separate left and right, the difference is fixed and two coordinates remain.

The sets to try first are an orthogonal array (CN104359492A, step 5). In an orthogonal array (of
strength two) each pair of columns has each pair of levels equally often. Bose's construction gives
q^2 rows of q + 1 columns for any prime power q: the points of a plane over the field of q
elements, a column for each direction of parallel lines.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product
import math

import numpy as np

from odocal_ros.calib.wheel_search.planar import PlanarLeg
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.errors import BadUsage
from odocal_ros.settings.config import WheelsConfig

NAMES = ('left', 'right', 'heading')
# definition: columns mean, difference (right minus left), heading
FREE = np.array([[1.0, -0.5, 0.0], [1.0, 0.5, 0.0], [0.0, 0.0, 1.0]])
# definition: a polynomial without factors for each field whose size is a power of a prime:
# coefficients, the lowest power first, that of the highest is 1
MODULI = {4: (1, 1), 8: (1, 0, 1), 9: (1, 0), 16: (1, 0, 0, 1), 25: (1, 1), 27: (1, 0, 2),
          49: (1, 0)}


def prime_power(q: int) -> tuple[int, int] | None:
    """Return (p, m) with q = p^m, p prime; None if q is not a prime power."""
    p = next((d for d in range(2, math.isqrt(max(q, 0)) + 1) if q % d == 0), q)
    if p < 2:
        return None
    m = 0
    while q % p == 0:
        q, m = q // p, m + 1
    return (p, m) if q == 1 else None


def next_prime_power(n: int, odd: bool = False) -> int:
    """Return the least prime power not below n; odd: of an odd prime."""
    q = max(n, 2)
    while prime_power(q) is None or (odd and q % 2 == 0):
        q += 1
    return q


@cache
def field_tables(q: int) -> tuple[Ints, Ints]:
    """
    Return addition and multiplication of the field of q elements: (q, q) each, of numbers 0..q-1.

    An element is the number whose digits to base p are the coefficients of a polynomial.
    """
    power = prime_power(q)
    if power is None or power[1] > 1 and q not in MODULI:
        raise BadUsage(f'{q} levels: there is no array; give a prime, or one of '
                       f'{", ".join(map(str, MODULI))}')
    p, m = power
    digits = np.array([[k // p**i % p for i in range(m)] for k in range(q)])
    weight = p**np.arange(m)
    add = ((digits[:, None] + digits) % p) @ weight
    # products of the polynomials, then their remainders by the modulus
    products = np.zeros((q, q, 2 * m - 1), np.int64)
    for i, j in product(range(m), repeat=2):
        products[..., i + j] += np.multiply.outer(digits[:, i], digits[:, j])
    for k in range(2 * m - 2, m - 1, -1):      # x^k = -x^(k-m) * (modulus - x^m)
        products[..., k - m:k] -= products[..., k, None] * np.array(MODULI[q], np.int64)
    return add, (products[..., :m] % p) @ weight


def bose_array(q: int, columns: int) -> Ints:
    """
    Return Bose's orthogonal array L(q^2)(q^columns): (q^2, columns) level numbers.

    Raises BadUsage if q is no prime power, or the number of columns is not 1 to q + 1.
    """
    add, multiply = field_tables(q)
    if not 1 <= columns <= q + 1:
        raise BadUsage(f'{columns} columns: an array of {q} levels has 1 to {q + 1}')
    i, j = np.divmod(np.arange(q * q), q)
    slopes = [add[i, multiply[c, j]] for c in range(q)]     # slope 0 is i itself
    return np.stack([slopes[0], j, *slopes[1:]][:columns], -1)


def full_factorial(levels: tuple[int, ...]) -> Ints:
    """Return all combinations: (product of levels, columns)."""
    return np.stack([g.ravel() for g in np.indices(tuple(levels))], -1).astype(np.int64)


def design_for(levels: int) -> tuple[str, Ints]:
    """
    Return name and level numbers, from 0, of the sets of three parameters to try: (n, 3).

    levels : of each. One or two: all combinations; more, a prime power: an orthogonal array.
    """
    if levels < 1:
        raise BadUsage(f'{levels} levels: give 1 or more for each parameter')
    if levels < 3:
        return f'all {levels**3} combinations', full_factorial((levels,) * 3)
    return f'L{levels**2}({levels}^{levels + 1})', bose_array(levels, 3)


@dataclass(frozen=True, eq=False)
class Space:
    """Linear map x = T q from search coordinates q: (mean, difference, heading) of the wheels."""

    ratio_is_fixed: bool      # True: left over right is that of the start; q is (mean, heading)

    @property
    def T(self) -> Floats:     # noqa: N802
        """Return the matrix of x = T q: (3, n)."""
        return FREE[:, [0, 2]] if self.ratio_is_fixed else FREE

    @property
    def S(self) -> Floats:     # noqa: N802
        """Return the matrix, (n, n), of the bounded v = S q: v is x, or mean and heading."""
        return np.eye(2) if self.ratio_is_fixed else FREE

    def q_of(self, x: Floats) -> Floats:
        """Return the coordinates q of x, (3,): (n,)."""
        left, right, heading = x
        mean = (left + right) / 2
        return np.array([mean, heading] if self.ratio_is_fixed else
                        [mean, right - left, heading])

    def bounds(self, half_range: Floats) -> Floats:
        """Return the half range of v from that of x: (n,)."""
        return np.array([min(half_range[:2]), half_range[2]]) if self.ratio_is_fixed \
            else np.array(half_range)

    def widened(self, half_range: Floats, on_edge: Bools) -> Floats:
        """Return the half range of x, doubled where v is on its edge, with positive scales."""
        edge = np.array([on_edge[0], *on_edge]) if self.ratio_is_fixed else np.asarray(on_edge)
        widest = np.array([0.9, 0.9, 1.5 * np.pi])
        return np.where(edge, np.minimum(2 * np.asarray(half_range), widest), half_range)


def parameter_sets(leg: PlanarLeg, x: Floats) -> Floats:
    """Return parameter sets (scales in m per unit, heading in rad) of (m, 3) x: (m, 3)."""
    x = np.atleast_2d(np.asarray(x, dtype=float))
    return np.stack([leg.scale_left * (1 + x[:, 0]), leg.scale_right * (1 + x[:, 1]), x[:, 2]], -1)


@dataclass(frozen=True, eq=False)
class Ranges:
    """Search ranges about the start values."""

    half_range: Floats             # (3,) of left and right (relative) and heading (rad)
    sources: tuple[str, str, str]  # setting or reason of each
    levels: int                    # number of levels of each

    def values(self, rows: Ints) -> Floats:
        """Return x of the rows of an array: equal steps from -half_range to half_range."""
        if self.levels == 1:
            return np.zeros(rows.shape)
        return (2 * rows / (self.levels - 1) - 1) * self.half_range

    @property
    def step(self) -> Floats:
        """Return the step between levels; for one or two levels the half range."""
        return 2 * self.half_range / max(self.levels - 1, 2)


def search_ranges(wheels: WheelsConfig, heading_sigma: float | None = None) -> Ranges:
    """
    Return the ranges by the settings.

    wheels : ``radius_range``, ``heading_range``, ``levels``.   heading_sigma : of heading and
    mounting angle together, rad; None: unknown.
    """
    if wheels.radius_range > 0:
        scale, scale_source = wheels.radius_range, 'wheels.radius_range'
    else:
        default_scale = 0.05
        scale, scale_source = default_scale, (
            'no wheel error is configured (wheels.radius_range): 5 % assumed')
    if wheels.heading_range > 0:
        heading, heading_source = wheels.heading_range, 'wheels.heading_range'
    elif heading_sigma:
        heading, heading_source = min(2 * heading_sigma, np.pi), 'twice the sigma of the heading'
    else:
        default_heading = np.deg2rad(10.0)
        heading, heading_source = default_heading, (
            'no heading error is configured (wheels.heading_range): 10 deg assumed for heading '
            'and mounting angle together')
    # an odd number has zero among its levels
    n = wheels.levels if wheels.levels < 3 else next_prime_power(wheels.levels, odd=True)
    return Ranges(np.array([scale, scale, heading]),
                  (scale_source, scale_source, heading_source), n)
