# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples: checked when created, cut, joined; identical in pieces and in files."""

import errno
import os
from pathlib import Path
import re
import tracemalloc

import numpy as np
import pytest

from odocal_ros.data import arrays, samples as s, spool
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import ImuSamples, take
from odocal_ros.errors import BadData
from odocal_ros.nav.time_series import double_integral_at, integral_at

pytestmark = pytest.mark.core
ROW = 104      # bytes of an IMU row
N = 20_000


@pytest.fixture(scope='module')
def imu():
    stamp = 10**9 + np.arange(N) * 1_000_000
    x = np.random.default_rng(3).standard_normal((N, 11))
    return ImuSamples(stamp, stamp + 5, x[:, :3], x[:, 3:6], x[:, 6:10], x[:, 10])


def assert_same(rows, imu, first=0, last=N):
    for name, column in vars(imu).items():
        np.testing.assert_array_equal(getattr(rows, name), column[first:last], err_msg=name)


def test_a_block_is_read_only_and_owns_its_rows():
    stamps, value = np.array([1, 2, 3]), np.array([7, 8, 9])
    block = s.OdometerSamples(stamps, stamps, value)
    value[0] = 99
    assert block.value[0] == 7
    with pytest.raises(ValueError, match='read-only'):
        block.value[0] = 1
    with pytest.raises(AttributeError):
        block.value = value


def test_counters_remain_integers_and_speeds_floats():
    assert s.OdometerSamples([1], [1], np.array([2**63 - 1])).value[0] == 2**63 - 1
    assert s.OdometerSamples([1], [1], np.array([3], np.uint16)).value.dtype == np.int64
    assert s.OdometerSamples([1], [1], np.array([0.5], np.float32)).value.dtype == np.float64


@pytest.mark.parametrize('bad', [
    lambda: s.OdometerSamples([1, 2], [1, 2], np.zeros(3)),
    lambda: s.OdometerSamples([1, 2], [1], np.zeros(2)),
    lambda: s.ImuSamples([1], [1], np.zeros((1, 2)), np.zeros((1, 3)), np.zeros((1, 4)), [0.0]),
    lambda: s.FixSamples([1], [1], [0.0], [0.0], [0.0], np.zeros((1, 9)), [0], [0])])
def test_a_wrong_shape_is_refused_by_name(bad):
    with pytest.raises(BadData, match=r'Samples\.\w+: required shape'):
        bad()


def test_cut_and_joined_samples_equal_the_whole(imu):
    parts = [take(imu, slice(a, b)) for a, b in ((0, 1), (1, 1), (1, 5), (5, N))]
    assert_same(s.join(parts), imu)
    assert s.join([imu]) is imu


@pytest.mark.parametrize('empty', [kind.empty for kind in s.Samples.__subclasses__()])
def test_an_empty_block_has_no_rows_and_joins_with_others(empty):
    assert len(empty().stamp_ns) == 0
    assert len(s.join([empty(), empty()]).stamp_ns) == 0


def wild(*shape):
    """Return values of all sizes, some of them zero, NaN or infinite."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=shape) * 10.0**rng.integers(-160, 150, shape)
    for value in (0.0, -0.0, np.nan, np.inf):
        x[rng.random(shape) < 0.02] = value
    return x


@pytest.mark.parametrize('columns', [1, 3, 4])
@pytest.mark.parametrize('ufunc', [np.maximum, np.add, np.logical_and, np.logical_or])
def test_across_equals_the_reduction_by_numpy(ufunc, columns):
    x = np.abs(wild(1000, columns))
    x = x > 1 if ufunc in (np.logical_and, np.logical_or) else x
    np.testing.assert_array_equal(arrays.reduce_columns(ufunc, x), ufunc.reduce(x, axis=1))


@pytest.mark.parametrize('columns', [3, 4])
def test_lengths_equal_the_row_norms_of_numpy(columns):
    x = wild(1000, columns)
    with np.errstate(over='ignore'):
        np.testing.assert_array_equal(arrays.lengths(x), np.linalg.norm(x, axis=1))


# data of which the subset gives a good, a poor or no bound of the median
UNLIKE = {'noise': lambda x: x, 'steps': np.round, 'one': np.ones_like, 'sorted': np.sort,
          'misled': lambda x: np.where(np.arange(len(x)) % 64, x, 9.0),
          'infinite': lambda x: np.where(x > 0, np.inf, x),
          'nan': lambda x: np.where(x > 4, np.nan, x)}


@pytest.mark.parametrize('kind', UNLIKE)
def test_median_of_many_rows_equals_that_of_numpy(kind):
    for n in (arrays.CHUNK_ROWS, arrays.CHUNK_ROWS + 1):
        x = UNLIKE[kind](np.random.default_rng(5).normal(size=n))
        np.testing.assert_array_equal(arrays.median(x), np.median(x))
        both = np.stack([x, -x], -1)
        np.testing.assert_array_equal(arrays.medians(both), np.median(both, axis=0))


@pytest.mark.parametrize('rows', [0, 5, arrays.CHUNK_ROWS, 2 * arrays.CHUNK_ROWS + 100])
def test_evenly_spaced_rows_equal_a_slice(rows):
    x = np.arange(3 * rows).reshape(-1, 3)
    for expected in (4, 1000, arrays.CHUNK_ROWS):
        np.testing.assert_array_equal(arrays.thinned(x, expected), x[::max(1, rows // expected)])


def test_an_integral_over_pieces_equals_the_integral_at_once():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.5, 1.5, 2 * arrays.CHUNK_ROWS + 100))
    x = rng.normal(size=(len(t), 2))
    slices = (x[:-1] + x[1:]) / 2 * np.diff(t)[:, None]
    whole = np.concatenate([np.zeros((1, 2)), np.cumsum(slices, axis=0)])
    times = [np.linspace(t[0] - 2, t[-1] + 2, 500), np.sort(rng.uniform(t[0], t[-1], 77))]
    for each in times:
        want = np.stack([np.interp(each, t, whole[:, k]) for k in (0, 1)], -1)
        np.testing.assert_array_equal(integral_at(each, t, x), want)
    again = np.append(0.0, np.cumsum((whole[:-1, 0] + whole[1:, 0]) / 2 * np.diff(t)))
    np.testing.assert_array_equal(double_integral_at(times[0], t, x[:, 0]),
                                  np.interp(times[0], t, again))


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Move rows to the file from 200 kB on."""
    for name, size in (('MEMORY_BYTES', 200_000), ('TAIL_BYTES', 50_000),
                       ('MERGED_BYTES', 20_000)):
        monkeypatch.setattr(spool, name, size)
    monkeypatch.setattr(arrays, 'MAX_RESIDENT_BYTES', 0)


def fed(recorder, imu, first, last):
    for k in range(first, last, 50):
        recorder.feed('imu', take(imu, slice(k, k + 50)))
    return recorder


def test_rows_of_a_file_equal_the_received_ones(imu):
    recorder = fed(LegRecorder(), imu, 0, 9_025)
    copy = recorder.snapshot()
    fed(recorder, imu, 9_050, 15_000)
    rows = copy.rows('imu')
    assert_same(rows, imu, 0, 9_050)
    arrays.release_mapped_memory()
    assert_same(rows, imu, 0, 9_050)
    assert_same(recorder.rows('imu'), imu, 0, 15_000)
    # only the pre-roll of the next leg remains, and the copy is unchanged
    recorder.forget_before(int(imu.stamp_ns[14_000]))
    assert_same(fed(recorder, imu, 15_000, N).rows('imu'), imu, 14_000, N)
    assert_same(copy.rows('imu'), imu, 0, 9_050)


def test_a_large_array_is_zero_and_can_be_released(monkeypatch):
    monkeypatch.setattr(arrays, 'WORK_ARRAY_BYTES', 4_000)
    for dtype in (float, bool, np.int64):
        array = arrays.work_array(1000, 5, dtype=dtype)
        assert array.dtype == dtype
        assert not array.any()
        assert not array.flags.owndata
        array[3:] = 1
        arrays.release_mapped_memory()
        assert array.sum() == 997 * 5
    whole = arrays.work_array(10)
    assert whole.flags.owndata

    def full(*_):
        raise OSError(28, 'no space left on device')
    monkeypatch.setattr(arrays.os, 'posix_fallocate', full)
    assert arrays.work_array(1000, 5).sum() == 0.0        # in memory instead


def test_large_arrays_in_files_are_released(monkeypatch):
    array = arrays.work_array(arrays.WORK_ARRAY_BYTES // 8)
    array[:] = 1

    def resident():
        (block,) = re.findall(rf'^{array.ctypes.data:x}-.*\n(?:\w+:.*\n)*?Rss: +(\d+)',
                              Path('/proc/self/smaps').read_text(), re.MULTILINE)
        return int(block) * 1024

    monkeypatch.setattr(arrays, 'MAX_RESIDENT_BYTES', array.nbytes)
    arrays.release_mapped_memory()
    assert resident() == array.nbytes
    monkeypatch.setattr(arrays, 'MAX_RESIDENT_BYTES', array.nbytes - 1)
    arrays.release_mapped_memory()
    assert resident() == 0
    assert array.sum() == len(array)


def test_a_leg_takes_no_more_memory_as_it_grows(imu):
    tracemalloc.start()
    recorder = fed(LegRecorder(), imu, 0, N // 2)
    before = tracemalloc.get_traced_memory()[0]
    fed(recorder, imu, N // 2, N)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 5 * N // 2 < ROW * N // 2      # bytes for each row


def test_rows_are_kept_in_memory_if_the_disk_is_full(imu, monkeypatch):
    write, left = os.pwrite, [40]

    def full(*args):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return write(*args)

    monkeypatch.setattr(os, 'pwrite', full)
    assert_same(fed(LegRecorder(), imu, 0, N).rows('imu'), imu)
