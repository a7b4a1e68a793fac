# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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
