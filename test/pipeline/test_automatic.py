# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Automatic legs: where they begin and end, the same for any order and size of blocks."""

from types import SimpleNamespace

import numpy as np
import pytest

from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.pipeline.automatic import LEG_END_REST_NS, LegSearch, PARKED_NS, START_REST_NS
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
SECOND = 10**9
START = 1_750_000_000 * SECOND
COUNTER = OdometerForm('cumulative', 2**16, 'm/pulse')
SPEED = OdometerForm('rate', 0, '1')
CONFIG = with_settings(Config(), {'leg.automatic': True, 'leg.automatic_minutes': 5.0})


def rows(stamp_ns, value=None):
    """Return rows of an odometer; without values: of a sensor, with stamps only."""
    if value is None:
        return SimpleNamespace(stamp_ns=np.asarray(stamp_ns), value=None)
    return OdometerSamples(stamp_ns, stamp_ns, value)


def sent(drive, form=COUNTER, imu_gap=(0, 0), only_counts=False):
    """
    Return slot -> rows of a drive: a list of (seconds, m/s), 50 counts a metre.

    imu_gap : s without IMU rows.   only_counts : a row only where there is a new count.
    """
    ends = np.cumsum([length for length, _ in drive])
    t = np.arange(0.01, ends[-1], 0.05)
    speed = np.array([v for _, v in drive])[np.searchsorted(ends, t, side='right')]
    travel = np.cumsum(speed) * 0.05
    value = speed if form is SPEED else np.floor(50 * travel).astype(np.int64) % 2**16
    keep = np.diff(value, prepend=value[0]) != 0 if only_counts else np.ones(len(t), bool)
    imu = np.arange(0.0, ends[-1] + 0.2, 0.02)
    imu = imu[(imu <= imu_gap[0]) | (imu >= imu_gap[1])]

    def ns(seconds):
        return START + np.round(seconds * 1e9).astype(np.int64)
    return {'imu': rows(ns(imu)), 'odometer': rows(ns(t[keep]), value[keep]),
            'fix': rows(ns(np.arange(0.5, ends[-1])))}


def legs(topics, form=COUNTER, config=CONFIG):
    search = LegSearch(config)
    for slot, block in topics.items():
        search.feed(slot, block, form)
    return in_seconds(search)


def in_seconds(search):
    return [((leg.start_ns - START) / 1e9, leg.stop_ns and (leg.stop_ns - START) / 1e9)
            for leg in search.spans]


# starts at 60 s, a red light at 120, a stop at 260 that is long enough, then ten minutes
TOWN = [(60, 0), (60, 10), (20, 0), (120, 10), (30, 0), (600, 10), (30, 0)]
BEFORE, REST, PARKED = (x / SECOND for x in (START_REST_NS, LEG_END_REST_NS, PARKED_NS))


@pytest.mark.parametrize(('form', 'only_counts'), [(COUNTER, False), (SPEED, False),
                                                   (COUNTER, True)])
def test_legs_end_at_standstills_or_after_the_longest_time(form, only_counts):
    found = legs(sent(TOWN, form, only_counts=only_counts), form)
    first = 60 if only_counts else 60 - BEFORE      # no odometer row before the first count
    expected = [(first, 260 + REST), (290 - BEFORE, 590 - BEFORE),
                (590 - BEFORE, 890 - BEFORE), (890 - BEFORE, 0)]
    # in motion, one begins where the other ends
    assert [b for _, b in found[1:3]] == [a for a, _ in found[2:]]
    # motion below 0.02 m, two counts and the travel of a row is not detected: 0.1 s
    assert np.array(found) == pytest.approx(np.array(expected), abs=0.15)


def test_a_long_stop_ends_a_leg_and_a_shorter_one_when_the_vehicle_starts():
    parked = [(30, 0), (60, 10), (PARKED + 5, 0), (400, 10)]
    assert legs(sent(parked))[0] == pytest.approx((30 - BEFORE, 90 + REST), abs=0.15)
    light = [(30, 0), (60, 10), (PARKED - 5, 0), (400, 10)]
    assert legs(sent(light))[0] == pytest.approx((30 - BEFORE, 330 - BEFORE), abs=0.15)
    found = legs(sent([(30, 0), (200, 10), (6, 0), (200, 10)]))
    assert found == [pytest.approx((30 - BEFORE, 236 - BEFORE), abs=0.15),
                     pytest.approx((236 - BEFORE, 0), abs=0.15)]


def test_an_imu_gap_is_between_two_legs():
    found = legs(sent([(30, 0), (200, 10)], imu_gap=(100.0, 103.0)))
    assert found == [pytest.approx((30 - BEFORE, 100.0), abs=0.15),
                     pytest.approx((103.0, 0), abs=0.15)]
    assert len(legs(sent([(30, 0), (200, 10)], imu_gap=(100.0, 100.4)))) == 1     # leg.max_gap


def test_no_leg_begins_before_all_topics_are_received():
    topics = sent([(30, 0), (200, 10)])
    topics['fix'] = rows(topics['fix'].stamp_ns[100:])        # the first at 100.5 s
    assert legs(topics) == [pytest.approx((100.5, 0), abs=0.15)]
    del topics['fix']
    assert legs(topics) == []
    surveyed = with_settings(CONFIG, {'reference.start': (40.0, 116.0, 50.0, 0.1),
                                      'reference.end': (40.0, 116.1, 50.0, 0.1)})
    assert len(legs(topics, config=surveyed)) == 1


@pytest.mark.parametrize('seed', range(5))
def test_legs_do_not_depend_on_block_sizes(seed):
    rng = np.random.default_rng(seed)
    topics = sent(TOWN, imu_gap=(700.0, 702.0))
    pieces = []
    for slot, block in topics.items():
        late = {'imu': 0, 'odometer': 0.3, 'fix': 0.5}[slot] * SECOND
        for some in np.array_split(np.arange(len(block.stamp_ns)), 400):
            pieces.append((block.stamp_ns[some[-1]] + rng.uniform(0, 1) * late, slot, some))
    search = LegSearch(CONFIG)
    for _, slot, some in sorted(pieces, key=lambda piece: piece[0]):
        block = topics[slot]
        search.feed(slot, rows(block.stamp_ns[some], None if block.value is None
                               else block.value[some]), COUNTER)
    assert in_seconds(search) == legs(topics)


def test_automatic_legs_continue_after_a_leg_of_the_operator():
    topics = sent(TOWN)
    for at_rest, expected in ((False, 200.0), (True, 290 - BEFORE)):
        search, cut = LegSearch(CONFIG), START + 200 * SECOND
        for slot in ('fix', 'imu'):
            search.feed(slot, topics[slot])
        block = topics['odometer']
        for some in (block.stamp_ns < cut, block.stamp_ns >= cut):
            search.feed('odometer', rows(block.stamp_ns[some], block.value[some]), COUNTER)
            if len(search.spans) == 1:
                search.restart(cut, at_rest)
        assert in_seconds(search)[0][0] == pytest.approx(expected, abs=0.15)
