# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the recorder keeps: bounded by the pre-roll, whatever is closed from it meanwhile."""

import numpy as np

from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import OdometerSamples

SECOND = 1_000_000_000


def block(begin_s, rows=5):
    stamps = begin_s * SECOND + np.arange(rows) * SECOND // 10
    return OdometerSamples(stamps, stamps, np.arange(rows))


def kept(recorder, slot):
    return len(recorder.snapshot().rows(slot).stamp_ns)


def test_closing_legs_from_snapshots_does_not_keep_old_rows():
    recorder = LegRecorder()
    for second in range(1, 200):
        recorder.feed('odometer', block(second))
        if second % 20 == 0:
            leg = recorder.snapshot().close((second - 10) * SECOND, second * SECOND, preroll=5.0)
            assert len(leg.odometer.stamp_ns) == 15 * 5 + 2  # 5 + 10 s, the mark, one row beyond
        recorder.forget_before((second - 15) * SECOND)
    assert kept(recorder, 'odometer') == 16 * 5


def test_forgetting_one_topic_leaves_the_others():
    recorder = LegRecorder()
    for slot in ('odometer', 'odometer_right'):
        for second in range(1, 10):
            recorder.feed(slot, block(second))
    recorder.forget_before(6 * SECOND, ('odometer',))
    assert (kept(recorder, 'odometer'), kept(recorder, 'odometer_right')) == (4 * 5, 9 * 5)


def test_a_snapshot_does_not_grow():
    recorder = LegRecorder()
    recorder.feed('odometer', block(1))
    copy = recorder.snapshot()
    recorder.feed('odometer', block(2))
    assert (len(copy.rows('odometer').stamp_ns), copy.newest_ns('odometer')) == (
        5, int(1.4 * SECOND))
    assert kept(recorder, 'odometer') == 10
