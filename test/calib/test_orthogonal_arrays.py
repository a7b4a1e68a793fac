# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orthogonal arrays are balanced, as many as there are prime powers, and no smaller ones exist."""

from itertools import combinations, product

import numpy as np
import pytest

from odocal_ros.calib.wheel_search import arrays
from odocal_ros.errors import BadUsage

pytestmark = pytest.mark.core
PRIME_POWERS = [2, 3, 4, 5, 7, 8, 9, 11, 13, 16]


def balanced(array):
    """Return True if each pair of columns of as many rows as pairs holds each pair once."""
    return all(len({tuple(pair) for pair in array[:, [a, b]].tolist()}) == len(array)
               for a, b in combinations(range(array.shape[1]), 2))


def test_prime_powers_are_told_from_other_numbers():
    assert [q for q in range(18) if arrays.prime_power(q)] == [*PRIME_POWERS, 17]
    assert arrays.prime_power(49) == (7, 2)
    assert arrays.prime_power(64) == (2, 6)
    assert arrays.prime_power(6) is None
    assert [arrays.next_prime_power(n) for n in (1, 6, 10, 14, 18)] == [2, 7, 11, 16, 19]
    assert [arrays.next_prime_power(n, odd=True) for n in (3, 4, 8, 14, 26, 50)] == [
        3, 5, 9, 17, 27, 53]


@pytest.mark.parametrize('q', [*PRIME_POWERS, 25, 27])
def test_the_tables_are_those_of_a_field(q):
    add, multiply = arrays.field_tables(q)
    a, b, c = np.indices((q, q, q))
    assert (add[add[a, b], c] == add[a, add[b, c]]).all()
    assert (multiply[multiply[a, b], c] == multiply[a, multiply[b, c]]).all()
    assert (multiply[a, add[b, c]] == add[multiply[a, b], multiply[a, c]]).all()
    each = np.arange(q)
    assert (np.sort(add, axis=1) == each).all()
    assert (np.sort(multiply[1:], axis=1) == each).all()       # so each has an inverse
    assert (add == add.T).all()
    assert (multiply == multiply.T).all()
    assert (multiply[1] == each).all()
    assert (add[0] == each).all()


@pytest.mark.parametrize(('p', 'm'), [(2, 2), (2, 4), (3, 2), (3, 3), (5, 2)])
def test_the_polynomial_found_is_no_product(p, m):
    found = arrays.irreducible(p, m)
    assert found[-1] == 1
    for d in range(1, m // 2 + 1):
        for low, high in product(product(range(p), repeat=d), product(range(p), repeat=m - d)):
            factors = np.polynomial.polynomial.polymul((*low, 1), (*high, 1))
            assert tuple(factors.astype(int) % p) != found


@pytest.mark.parametrize('q', [*PRIME_POWERS, 25, 49])
def test_every_array_is_balanced(q):
    array = arrays.bose(q, q + 1)
    assert array.shape == (q * q, q + 1)
    assert balanced(array)
    array[3, 1] = (array[3, 1] + 1) % q     # and one wrong cell is seen
    assert not balanced(array)
    # three of each level in each column: L9(3^4) of the patent's figure 2, but for the order
    assert all((np.bincount(column) == q).all() for column in arrays.bose(q, q + 1).T)


def test_what_cannot_be_built_is_refused():
    with pytest.raises(BadUsage, match='6 levels'):
        arrays.bose(6, 3)
    with pytest.raises(BadUsage, match='5 columns'):
        arrays.bose(3, 5)
    with pytest.raises(BadUsage, match='0 levels'):
        arrays.design_for(0)


@pytest.mark.parametrize(('levels', 'rows'), [(1, 1), (2, 8), (3, 9), (4, 16), (7, 49), (9, 81)])
def test_the_design_follows_the_levels(levels, rows):
    design = arrays.design_for(levels)
    assert design.rows.shape == (rows, 3)
    assert levels != 9 or design.name == 'L81(9^10)'
    assert levels == 2 or balanced(design.rows)
    assert [len(set(column)) for column in design.rows.T.tolist()] == [levels] * 3
