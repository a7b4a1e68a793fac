# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rows that go to a file are the rows that came, and take no memory as they grow."""

import errno
import os
from pathlib import Path
import re
import tracemalloc

import numpy as np
import pytest

from odocal_ros.data import mapped, spool
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.mapped import let_go
from odocal_ros.data.samples import ImuSamples, take

pytestmark = pytest.mark.core
ROW = 104      # bytes of an IMU row
N = 20_000


@pytest.fixture(scope='module')
def imu():
    rng = np.random.default_rng(3)
    stamp = 10**9 + np.arange(N) * 1_000_000
    x = rng.standard_normal((N, 11))
    return ImuSamples(stamp, stamp + 5, x[:, :3], x[:, 3:6], x[:, 6:10], x[:, 10])


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Let rows go to the file from 200 kB on."""
    for name, size in (('MEMORY_BYTES', 200_000), ('TAIL_BYTES', 50_000),
                       ('MERGED_BYTES', 20_000)):
        monkeypatch.setattr(spool, name, size)
    monkeypatch.setattr(mapped, 'HELD_BYTES', 0)


def fed(recorder, imu, first, last):
    for k in range(first, last, 50):
        recorder.feed('imu', take(imu, slice(k, k + 50)))
    return recorder


def assert_same(rows, imu, first, last):
    for name, column in vars(imu).items():
        np.testing.assert_array_equal(getattr(rows, name), column[first:last], err_msg=name)


def test_rows_of_a_file_are_those_that_came(imu):
    recorder = fed(LegRecorder(), imu, 0, 9_025)
    copy = recorder.snapshot()
    fed(recorder, imu, 9_050, 15_000)
    rows = copy.rows('imu')
    assert_same(rows, imu, 0, 9_050)
    let_go()
    assert_same(rows, imu, 0, 9_050)
    assert_same(recorder.rows('imu'), imu, 0, 15_000)
    # the pre-roll of the next leg is what is left, and the copy is as it was
    recorder.forget_before(int(imu.stamp_ns[14_000]))
    assert_same(fed(recorder, imu, 15_000, N).rows('imu'), imu, 14_000, N)
    assert_same(copy.rows('imu'), imu, 0, 9_050)


def test_a_large_room_is_zeros_that_can_be_let_go(monkeypatch):
    monkeypatch.setattr(mapped, 'ROOM_BYTES', 4_000)
    for dtype in (float, bool, np.int64):
        array = mapped.room(1000, 5, dtype=dtype)
        assert array.dtype == dtype
        assert not array.any()
        assert not array.flags.owndata
        array[3:] = 1
        let_go()
        assert array.sum() == 997 * 5
    whole = mapped.room(10)
    assert whole.flags.owndata

    def full(*_):
        raise OSError(28, 'no space left on device')
    monkeypatch.setattr(mapped.os, 'posix_fallocate', full)
    assert mapped.room(1000, 5).sum() == 0.0        # in memory, then


def test_arrays_in_files_are_let_go_once_they_are_large(monkeypatch):
    array = mapped.room(mapped.ROOM_BYTES // 8)
    array[:] = 1

    def resident():
        (block,) = re.findall(rf'^{array.ctypes.data:x}-.*\n(?:\w+:.*\n)*?Rss: +(\d+)',
                              Path('/proc/self/smaps').read_text(), re.MULTILINE)
        return int(block) * 1024

    monkeypatch.setattr(mapped, 'HELD_BYTES', array.nbytes)
    let_go()
    assert resident() == array.nbytes
    monkeypatch.setattr(mapped, 'HELD_BYTES', array.nbytes - 1)
    let_go()
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


def test_a_full_disk_costs_memory_only(imu, monkeypatch):
    write, left = os.pwrite, [40]

    def full(*args):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return write(*args)

    monkeypatch.setattr(os, 'pwrite', full)
    assert_same(fed(LegRecorder(), imu, 0, N).rows('imu'), imu, 0, N)
