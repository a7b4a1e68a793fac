# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orthogonal arrays are balanced, as many as there are prime powers, and no smaller ones exist."""

from itertools import combinations

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


# so the tables are those of a field, and the polynomial is no product
@pytest.mark.parametrize('q', [*PRIME_POWERS, 25, 27, 49])
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
