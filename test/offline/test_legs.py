# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs of a recording: as requested on the command line, as marked, from standstills."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import take
from odocal_ros.errors import BadData, BadUsage
from odocal_ros.library import find_legs
from odocal_ros.library.arguments import LegSpan, parse_leg
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.core
S = 10**9


@pytest.mark.parametrize(('text', 'span'), [
    ('12.5:70', LegSpan(12_500_000_000, 70 * S, True, True)),
    (':70', LegSpan(None, 70 * S, False, True)),
    ('3:', LegSpan(3 * S, None, True, False)),
    # a float64 of this second has a grain of 238 ns: the digits must survive
    ('1750000000.123456789:1750000100.000000001',
     LegSpan(1_750_000_000_123_456_789, 1_750_000_100_000_000_001, False, False)),
    ('2015-05-21T10:00:00Z/2015-05-21T10:01:00.5+00:00',
     LegSpan(1_432_202_400 * S, 1_432_202_460 * S + S // 2, False, False)),
    ('2015-05-21T10:00:00/', LegSpan(1_432_202_400 * S, None, False, False))])
def test_leg_is_parsed_to_the_nanosecond(text, span):
    assert parse_leg(text) == span


@pytest.mark.parametrize('text', ['', '5', '1:2:3', 'a:b', '70:12', '5:5', 'nan:3', '1/x',
                                  '2015-05-21T10:00:00Z/2014-05-21T10:00:00Z'])
def test_an_invalid_leg_is_refused_in_one_sentence(text):
    with pytest.raises(BadUsage, match='--leg'):
        parse_leg(text)


@dataclass
class StatusBag:
    """A bag with status messages of the node, newest last."""

    rows: list = field(default_factory=list)
    name: str = 'bag'
    start_ns: int = 0
    end_ns: int = 10**13

    @property
    def topics(self):
        return {'/calibrator/status': SimpleNamespace(
            name='/calibrator/status', msgtype='diagnostic_msgs/msg/DiagnosticArray')}

    def messages(self, topic):
        for leg_id, start, stop, event in self.rows:
            values = {'leg_id': leg_id, 'leg_start_ns': start, 'leg_stop_ns': stop,
                      'leg_event': event}
            pairs = [SimpleNamespace(key=k, value=str(v)) for k, v in values.items()]
            status = SimpleNamespace(name='calibrator: calibration', values=pairs)
            yield 0, SimpleNamespace(status=[status])


def test_marks_of_each_run_are_found_and_cancelled_legs_are_not():
    bag = StatusBag([
        ('', 0, 0, ''), ('1', 5 * S, 0, 'started'), ('1', 5 * S, 9 * S, 'stopped'),
        ('1', 5 * S, 9 * S, ''),
        ('2', 20 * S, 0, 'started'), ('2', 20 * S, 0, 'cancelled'), ('2', 20 * S, 0, ''),
        ('3', 30 * S, 0, 'started'), ('3', 30 * S, 40 * S, 'stopped'),
        ('3', 30 * S, 40 * S, 'undone'), ('4', 50 * S, 0, 'started')])
    marked = find_legs.marked_legs(bag)
    assert marked == [(5 * S, 9 * S), (50 * S, 0)]
    ended, broken_off = find_legs.missing_stop_reasons([(5 * S, 9 * S), (50 * S, 70 * S)], marked)
    assert (ended, [r.code for r in broken_off]) == ((), [Code.STOP_MARK_MISSING])
    bag = StatusBag([('1', 5 * S, 9 * S, 'stopped'), ('1', 20 * S, 0, 'started'),
                     ('1', 20 * S, 30 * S, 'stopped')])
    assert find_legs.marked_legs(bag) == [(5 * S, 9 * S), (20 * S, 30 * S)]


def recorded(drive):
    recorder = LegRecorder()
    for slot in ('imu', 'odometer', 'odometer_right', 'fix', 'heading'):
        recorder.feed(slot, getattr(drive, slot))
    recorder.form = drive.form
    stamps = drive.imu.stamp_ns
    return recorder, SimpleNamespace(name='bag', start_ns=int(stamps[0]), end_ns=int(stamps[-1]))


@pytest.fixture(scope='module')
def out_and_back():
    return simulate(SimOptions(scenario='out_and_back', imu_rate=50.0, odometer_rate=20.0))


def moving(drive, stamp):
    near = np.abs(drive.odometer.stamp_ns - stamp) < S // 2
    return np.ptp(drive.odometer.value[near]) > 2


def test_standstills_give_one_leg_or_several_if_requested(out_and_back):
    recorder, bag = recorded(out_and_back)
    (leg,) = find_legs.find_legs(recorder, bag, [], [], Config())
    # the opening standstill ends, and the closing one begins, within the detector's window
    assert abs(leg[0] - out_and_back.truth.start_ns) < S
    assert leg[1] >= out_and_back.truth.stop_ns - 2 * S
    assert not moving(out_and_back, leg[0] - S)
    assert not moving(out_and_back, leg[1])
    recorder, bag = recorded(out_and_back)
    legs = find_legs.find_legs(recorder, bag, ['each-stop'], [], Config())
    assert len(legs) == 2
    assert legs[0][1] == legs[1][0]
    for edge in (e for leg in legs for e in leg):
        assert not moving(out_and_back, edge - S)


def test_seconds_of_a_leg_begin_at_the_first_stamp_of_another_clock(out_and_back):
    """As in simulation time, or when the recording of a replay is recorded."""
    recorder, bag = recorded(out_and_back)
    span = LegSpan(20 * S, 70 * S, True, True)
    on_bag_clock = find_legs.find_legs(recorder, bag, [span], [], Config())
    bag.start_ns, bag.end_ns = (t + 10**16 for t in (bag.start_ns, bag.end_ns))
    (start, stop), = find_legs.find_legs(recorder, bag, [span], [], Config())
    assert stop - start == 50 * S
    assert abs(start - on_bag_clock[0][0]) < 2 * S      # the fixes begin later
    with pytest.raises(BadUsage, match='the leg 9000.00:9001.00 contains no data; the bag runs'):
        find_legs.find_legs(recorder, bag, [LegSpan(9000 * S, 9001 * S, True, True)], [], Config())


def test_stamps_without_common_time_are_refused(out_and_back):
    recorder, bag = recorded(out_and_back)
    late = LegRecorder()
    for slot in ('imu', 'odometer', 'fix'):
        rows = recorder.rows(slot)
        late.feed(slot, replace(rows, stamp_ns=rows.stamp_ns + 8 * 3600 * S * (slot == 'fix')))
    with pytest.raises(BadData, match='no time in common: IMU .* fix .*Stamp all sensors with'):
        find_legs.find_legs(late, bag, [], [], Config())
    mark = int(out_and_back.truth.start_ns), int(out_and_back.truth.stop_ns)
    assert find_legs.find_legs(late, bag, [], [mark], Config()) == [mark]


@pytest.mark.parametrize('slot', ['imu', 'odometer', 'fix'])
def test_a_topic_that_covers_half_of_the_recording_is_reported(out_and_back, slot):
    whole, _ = recorded(out_and_back)
    assert find_legs.coverage_reasons(whole) == ()
    begin, end = out_and_back.imu.stamp_ns[[0, -1]]
    half_s = (end - begin) / 2 / S
    for early in (True, False):
        recorder = LegRecorder()
        for name in ('imu', 'odometer', 'fix'):
            rows = whole.rows(name)
            kept = (rows.stamp_ns < (begin + end) // 2) == early
            recorder.feed(name, take(rows, kept | (name != slot)))
        (reason,) = find_legs.coverage_reasons(recorder)
        assert reason.code is Code.TOPIC_GAP
        missing = float(reason.text.split(' s ')[0].split()[-1])
        assert missing == pytest.approx(half_s, abs=2.0)      # fixes come each second
        assert f'{"ends" if early else "begins"} {missing:.0f} s' in reason.text


def test_marks_take_precedence_over_standstills_and_options_over_marks(out_and_back):
    recorder, bag = recorded(out_and_back)
    mark = (bag.start_ns + 100 * S, bag.start_ns + 200 * S)
    assert find_legs.find_legs(recorder, bag, [], [mark], Config()) == [mark]
    requested = parse_leg('120:150')
    assert find_legs.find_legs(recorder, bag, [requested], [mark], Config()) == [
        (bag.start_ns + 120 * S, bag.start_ns + 150 * S)]
    still_open = find_legs.find_legs(recorder, bag, [], [(mark[0], 0)], Config())
    assert still_open[0][1] == min(out_and_back.imu.stamp_ns[-1],
                                   np.median(out_and_back.imu.stamp_ns[-5:]),
                                   np.median(out_and_back.odometer.stamp_ns[-5:]),
                                   np.median(out_and_back.fix.stamp_ns[-5:]))


def test_a_leg_outside_the_bag_is_refused_with_the_span_of_the_bag(out_and_back):
    recorder, bag = recorded(out_and_back)
    with pytest.raises(BadUsage, match=r'runs from 0 to \d+\.\d s'):
        find_legs.find_legs(recorder, bag, [parse_leg('5000:6000')], [], Config())


def test_a_recording_that_ends_at_its_start_mark_is_reported():
    bag = SimpleNamespace(name='2026-01-02T03-04-05Z_leg_1')
    with pytest.raises(BadData, match='ended at the start mark.* drive it again'):
        find_legs._marked_spans([(10, 0)], 10, bag)
    assert find_legs._marked_spans([(10, 0)], 11, bag) == [(10, 11)]
