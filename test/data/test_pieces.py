# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pieces: what is computed some rows at a time is to the last bit what numpy has at once."""

import numpy as np
import pytest

from odocal_ros.data.pieces import across, lengths, median, medians, PIECE_ROWS
from odocal_ros.nav.integral import integral_at, integrals_at, twice_integral_at

pytestmark = pytest.mark.core


def wild(*shape):
    """Return values of all sizes, some of them zero, NaN or infinite."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=shape) * 10.0**rng.integers(-160, 150, shape)
    for value in (0.0, -0.0, np.nan, np.inf):
        x[rng.random(shape) < 0.02] = value
    return x


@pytest.mark.parametrize('columns', [1, 3, 4])
@pytest.mark.parametrize('ufunc', [np.maximum, np.add, np.logical_and, np.logical_or])
def test_across_is_what_numpy_reduces_rows_to(ufunc, columns):
    x = np.abs(wild(1000, columns))
    x = x > 1 if ufunc in (np.logical_and, np.logical_or) else x
    np.testing.assert_array_equal(across(ufunc, x), ufunc.reduce(x, axis=1))


@pytest.mark.parametrize('columns', [3, 4])
def test_lengths_are_numpys_norms_of_rows(columns):
    x = wild(1000, columns)
    with np.errstate(over='ignore'):
        np.testing.assert_array_equal(lengths(x), np.linalg.norm(x, axis=1))


def unlike(kind, n):
    """Return values of which those taken to tell the median say much, little, or nothing."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=n)
    return {'noise': x, 'steps': np.round(x), 'one': np.full(n, 2.0), 'sorted': np.sort(x),
            'misled': np.where(np.arange(n) % 64, x, 9.0), 'infinite': np.where(x > 0, np.inf, x),
            'nan': np.where(x > 4, np.nan, x)}[kind]


@pytest.mark.parametrize('kind', ['noise', 'steps', 'one', 'sorted', 'misled', 'infinite', 'nan'])
def test_a_median_of_many_rows_is_numpys(kind):
    for n in (PIECE_ROWS, PIECE_ROWS + 1):
        x = unlike(kind, n)
        np.testing.assert_array_equal(median(x), np.median(x))
        both = np.stack([x, -x], -1)
        np.testing.assert_array_equal(medians(both), np.median(both, axis=0))


def test_an_integral_over_pieces_is_that_at_once_at_each_of_several_times():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.5, 1.5, 2 * PIECE_ROWS + 100))
    x = rng.normal(size=(len(t), 2))
    slices = (x[:-1] + x[1:]) / 2 * np.diff(t)[:, None]
    whole = np.concatenate([np.zeros((1, 2)), np.cumsum(slices, axis=0)])
    times = [np.linspace(t[0] - 2, t[-1] + 2, 500), np.sort(rng.uniform(t[0], t[-1], 77))]
    for each, found in zip(times, integrals_at(times, t, x), strict=True):
        want = np.stack([np.interp(each, t, whole[:, k]) for k in (0, 1)], -1)
        np.testing.assert_array_equal(found, want)
        np.testing.assert_array_equal(integral_at(each, t, x), want)
    again = np.append(0.0, np.cumsum((whole[:-1, 0] + whole[1:, 0]) / 2 * np.diff(t)))
    np.testing.assert_array_equal(twice_integral_at(times[0], t, x[:, 0]),
                                  np.interp(times[0], t, again))
