# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Attitudes in plain numbers are those of arrays."""

import numpy as np
import pytest

from odocal_ros.apply.attitude import cross, matrix_of, product, skewed, turned
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply, skew


@pytest.mark.parametrize('size', [0.0, 1e-300, 1e-12, 1e-8, 1e-3, 1.0, 3.0])
def test_they_agree_to_the_last_digits(size):
    rng = np.random.default_rng(int(-np.log10(size + 1e-301)))
    q, r = rng.standard_normal((2, 4))
    q, r = q / np.linalg.norm(q), r / np.linalg.norm(r)
    phi, a = rng.standard_normal((2, 3)) * [[size], [1.0]]
    np.testing.assert_allclose(turned(q, phi), quat_multiply(q, quat_from_rotvec(phi)),
                               atol=1e-15)
    np.testing.assert_allclose(product(q, r), quat_multiply(q, r), atol=1e-15)
    np.testing.assert_allclose(matrix_of(3 * q), matrix_from_quat(q), atol=1e-15)
    np.testing.assert_array_equal(skewed(a), skew(a))
    np.testing.assert_allclose(cross(a, phi), np.cross(a, phi), atol=1e-15 * size)
