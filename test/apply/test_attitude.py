# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Attitudes in plain numbers are those of arrays."""

import numpy as np
import pytest

from odocal_ros.apply.attitude import (
    cross,
    matrix_of,
    plus,
    product,
    rotated,
    rotation,
    rotation_increment,
    skewed,
)
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply, skew
from odocal_ros.nav.strapdown import rotation_increments


@pytest.mark.parametrize('size', [0.0, 1e-300, 1e-12, 1e-8, 1e-3, 1.0, 3.0])
def test_they_agree_to_the_last_digits(size):
    rng = np.random.default_rng(int(-np.log10(size + 1e-301)))
    q, r = rng.standard_normal((2, 4))
    q, r = q / np.linalg.norm(q), r / np.linalg.norm(r)
    phi, a = rng.standard_normal((2, 3)) * [[size], [1.0]]
    np.testing.assert_allclose(rotation(phi), quat_from_rotvec(phi), atol=1e-15)
    np.testing.assert_allclose(product(q, r), quat_multiply(q, r), atol=1e-15)
    np.testing.assert_allclose(matrix_of(3 * q), matrix_from_quat(q), atol=1e-15)
    np.testing.assert_array_equal(skewed(a), skew(a))
    np.testing.assert_allclose(cross(a, phi), np.cross(a, phi), atol=1e-15 * size)
    np.testing.assert_allclose(rotated(matrix_of(q), a), matrix_from_quat(q) @ a, atol=1e-15)
    np.testing.assert_array_equal(plus(a, phi, 0.5), a + phi * 0.5)


@pytest.mark.parametrize('uneven', [0.0, 0.3, 0.9])
def test_rotation_increments_are_those_of_the_strapdown(uneven):
    rng = np.random.default_rng(1)
    t = 1000.0 + np.cumsum(0.01 * (1 + uneven * rng.uniform(-1, 1, 200)))
    w = np.cumsum(rng.standard_normal((200, 3)), axis=0)
    own = [rotation_increment(t.tolist(), w.tolist(), k) for k in range(199)]
    # both do the same sums in the same order
    np.testing.assert_array_equal(np.transpose(own), rotation_increments(t, w))
