# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs do not depend on block sizes and arrival order of topics; which rows are kept."""

from dataclasses import fields

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from odocal_ros.data.leg import LegRecorder, SLOTS
from odocal_ros.data.samples import FixSamples, HeadingSamples, ImuSamples, OdometerSamples, take
from odocal_ros.errors import BadData

pytestmark = pytest.mark.core
S = 10**9
START, STOP = 20 * S, 40 * S


def topic(slot, rng):
    """Return 60 s of one topic, from 1 s on, with some rows out of order and some unstamped."""
    n = {'imu': 600, 'odometer': 300, 'fix': 60, 'heading': 30}[slot]
    received = (1 + np.arange(n) * 60 // n) * S + np.arange(n)
    stamp = received - 1000
    stamp[rng.integers(0, n, 3)] = 0
    stamp[5:7] = stamp[6:4:-1]
    x = rng.standard_normal((n, 9))
    x[n // 2, 0] = np.nan
    if slot == 'imu':
        return ImuSamples(stamp, received, x[:, :3], x[:, 3:6], x[:, 5:9], x[:, 0])
    if slot == 'odometer':
        return OdometerSamples(stamp, received, np.arange(n) * 7)
    if slot == 'heading':
        return HeadingSamples(stamp, received, x[:, :4], x[:, 4])
    return FixSamples(stamp, received, x[:, 0], x[:, 1], x[:, 2], x.reshape(n, 3, 3),
                      np.full(n, 2), np.zeros(n))


def recorded(topics, order):
    """Feed a recorder blocks in an order of (slot, first, last)."""
    recorder = LegRecorder()
    for slot, a, b in order:
        recorder.feed(slot, take(topics[slot], slice(a, b)))
    return recorder


def rows(leg):
    return {f'{slot}.{f.name}': getattr(leg.rows(slot), f.name)
            for slot in SLOTS for f in fields(leg.rows(slot))}


def assert_same(leg, other):
    expected = rows(other)
    for name, column in rows(leg).items():
        np.testing.assert_array_equal(column, expected[name], err_msg=name)


TOPICS = {slot: topic(slot, np.random.default_rng(7))
          for slot in ('imu', 'odometer', 'fix', 'heading')}
WHOLE = recorded(TOPICS, [(s, 0, 10**6) for s in TOPICS]).close(START, STOP, preroll=5.0)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_a_leg_does_not_depend_on_block_sizes_and_arrival_order(data):
    pieces = {}
    for slot, block in TOPICS.items():
        n = len(block.stamp_ns)
        cuts = sorted(data.draw(st.sets(st.integers(1, n - 1), max_size=6), label=slot))
        pieces[slot] = list(zip([0, *cuts], [*cuts, n], strict=True))
    # the order is fixed within a topic, random between topics
    race = data.draw(st.permutations([s for s in pieces for _ in pieces[s]]), label='race')
    queues = {slot: iter(p) for slot, p in pieces.items()}
    recorder = recorded(TOPICS, [(slot, *next(queues[slot])) for slot in race])
    if data.draw(st.booleans(), label='forget'):
        recorder.forget_before(START - 5 * S)
    if data.draw(st.booleans(), label='look'):
        recorder.rows('imu')
    assert_same(recorder.snapshot().close(START, STOP, preroll=5.0), WHOLE)


def placed(block):
    return np.where(block.stamp_ns > 0, block.stamp_ns, block.received_ns)


def test_a_leg_has_the_preroll_and_one_row_after_the_stop():
    for slot, block in TOPICS.items():
        key, every = placed(WHOLE.rows(slot)), placed(block)
        assert key.min() >= START - 5 * S
        assert np.sum(key > STOP) == 1, slot
        assert key.max() == every[every > STOP].min()
        assert len(key) == np.sum((every >= START - 5 * S) & (every <= key.max()))


def test_a_leg_does_not_depend_on_the_time_of_closing():
    early, late = LegRecorder(), LegRecorder()
    for slot, block in TOPICS.items():
        early.feed(slot, take(block, placed(block) <= STOP + 3 * S))
        late.feed(slot, block)
    assert_same(early.close(START, STOP, 5.0), late.close(START, STOP, 5.0))


def test_clear_removes_all_rows_and_the_newest_stamp_is_the_last_fed():
    recorder = recorded(TOPICS, [('imu', 0, 100)])
    assert recorder.newest_ns('imu') == TOPICS['imu'].stamp_ns[99]
    assert recorder.newest_ns('fix') == 0
    recorder.clear()
    assert recorder.newest_ns('imu') == 0
    assert all(len(column) == 0 for column in rows(recorder.close(START, STOP)).values())


def test_a_first_row_years_after_the_mark_is_not_in_the_leg():
    late = 10**9 * 86400 * 4000
    recorder = LegRecorder()
    recorder.feed('odometer', OdometerSamples([10, 20, 30 + late], [10, 20, 30 + late], [1, 2, 3]))
    assert recorder.close(5, 25).odometer.value.tolist() == [1, 2]
    with pytest.raises(BadData, match='the leg lasts 4000 days'):
        recorder.close(5, 40 + late)


def test_rows_of_another_recorder_are_shared_without_a_copy():
    """Also under another name; later rows of that recorder are not shared."""
    one, both = recorded(TOPICS, [('odometer', 0, 100)]), recorded(TOPICS, [('imu', 0, 50)])
    both.adopt('odometer_right', one, 'odometer')
    both.adopt('imu', one, 'imu')
    assert np.shares_memory(both.rows('odometer_right').value, one.rows('odometer').value)
    one.feed('odometer', take(TOPICS['odometer'], slice(100, 200)))
    np.testing.assert_array_equal(both.rows('odometer_right').value, np.arange(100) * 7)
    assert both.newest_ns('odometer_right') == TOPICS['odometer'].stamp_ns[99]
    assert len(both.rows('imu').stamp_ns) == 50


def block(begin_s, rows=5):
    stamps = begin_s * S + np.arange(rows) * S // 10
    return OdometerSamples(stamps, stamps, np.arange(rows))


def kept(recorder, slot):
    return len(recorder.snapshot().rows(slot).stamp_ns)


def test_closing_legs_from_snapshots_does_not_keep_old_rows():
    recorder = LegRecorder()
    for second in range(1, 200):
        recorder.feed('odometer', block(second))
        if second % 20 == 0:
            leg = recorder.snapshot().close((second - 10) * S, second * S, preroll=5.0)
            assert len(leg.odometer.stamp_ns) == 15 * 5 + 2  # 5 + 10 s, the mark, one row beyond
        recorder.forget_before((second - 15) * S)
    assert kept(recorder, 'odometer') == 16 * 5


def test_removing_one_topic_keeps_other_topics_and_snapshots():
    recorder = LegRecorder()
    for slot in ('odometer', 'odometer_right'):
        for second in range(1, 10):
            recorder.feed(slot, block(second))
    copy = recorder.snapshot()
    recorder.forget_before(6 * S, ('odometer',))
    assert (kept(recorder, 'odometer'), kept(recorder, 'odometer_right')) == (4 * 5, 9 * 5)
    recorder.feed('odometer', block(10))
    assert (kept(copy, 'odometer'), copy.newest_ns('odometer')) == (9 * 5, round(9.4 * S))
