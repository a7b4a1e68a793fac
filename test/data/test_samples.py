# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples: frozen blocks, checked at birth, cut and joined without a trace."""

import numpy as np
import pytest

from odocal_ros.data import samples as s
from odocal_ros.errors import BadData

pytestmark = pytest.mark.core


def imu(n, first=0):
    row = np.arange(first, first + n)
    return s.ImuSamples(row * 10**7, row * 10**7 + 5, np.outer(row, [1.0, 2.0, 3.0]),
                        np.outer(row, [0.1, 0.2, 9.8]), np.tile([0.0, 0, 0, 1], (n, 1)),
                        np.full(n, np.nan))


def test_a_block_is_read_only_and_owns_its_rows():
    stamps, value = np.array([1, 2, 3]), np.array([7, 8, 9])
    block = s.OdometerSamples(stamps, stamps, value)
    value[0] = 99
    assert block.value[0] == 7
    with pytest.raises(ValueError, match='read-only'):
        block.value[0] = 1
    with pytest.raises(AttributeError):
        block.value = value


def test_counters_stay_whole_and_speeds_stay_real():
    assert s.OdometerSamples([1], [1], np.array([2**63 - 1])).value[0] == 2**63 - 1
    assert s.OdometerSamples([1], [1], np.array([3], np.uint16)).value.dtype == np.int64
    assert s.OdometerSamples([1], [1], np.array([0.5], np.float32)).value.dtype == np.float64


@pytest.mark.parametrize('bad', [
    lambda: s.OdometerSamples([1, 2], [1, 2], np.zeros(3)),
    lambda: s.OdometerSamples([1, 2], [1], np.zeros(2)),
    lambda: s.ImuSamples([1], [1], np.zeros((1, 2)), np.zeros((1, 3)), np.zeros((1, 4)), [0.0]),
    lambda: s.FixSamples([1], [1], [0.0], [0.0], [0.0], np.zeros((1, 9)), [0], [0]),
])
def test_a_wrong_shape_is_refused_by_name(bad):
    with pytest.raises(BadData, match=r'Samples\.\w+: required shape'):
        bad()


def test_what_is_cut_and_joined_is_the_whole():
    whole = imu(7)
    parts = [s.take(whole, slice(a, b)) for a, b in ((0, 1), (1, 1), (1, 5), (5, 7))]
    again = s.join(parts)
    for name in ('stamp_ns', 'received_ns', 'w_i', 'f_i', 'q_ni', 'yaw_variance'):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
    assert s.join([whole]) is whole


@pytest.mark.parametrize('empty', [kind.none for kind in s.Samples.__subclasses__()])
def test_an_empty_block_has_no_rows_and_joins_with_others(empty):
    assert len(empty().stamp_ns) == 0
    assert len(s.join([empty(), empty()]).stamp_ns) == 0
