# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect: findings on simulated drives with known faults."""

import math
import shlex
import struct

from inspect_output import codes, drive, inspect, K, planar, RATE, topic
import numpy as np
import pytest
import ros_bags
from ros_bags import T0
import ros_messages as make

from odocal_ros.library import find_legs
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow


@pytest.fixture
def inspect_drive(tmp_path, capsys):
    def written(rows, *options, types=None):
        path = ros_bags.write(tmp_path / f'bag_{len(list(tmp_path.iterdir()))}', rows, types=types)
        return inspect(path, capsys, *options)
    return written


@pytest.mark.core
def test_a_good_drive_lacks_only_a_heading(inspect_drive):
    seen, text = inspect_drive(drive())
    assert codes(seen) == {'YAW_NOT_SEPARABLE'}
    assert np.ravel(seen['standstills']) == pytest.approx([0, 12, 140, 150], abs=1.2)
    leg, = seen['legs']
    assert leg['distance'] == pytest.approx(planar()[1].sum() / RATE, rel=0.02)
    assert leg['start'] == pytest.approx(12, abs=1.2)
    assert seen['drive']['rough_scale'] == pytest.approx(K, rel=0.02)
    assert seen['drive']['gyro_over_course'] == pytest.approx(1, abs=0.05)
    assert seen['mounting'] == seen['mounting'] | {'rpy': [0, 0, 0], 'needed': False}
    assert seen['command'] == f'odocal replay {seen["path"]}'
    assert seen['replay_error'] == ''
    assert 'imu.mounting_rpy is correct to the nearest quarter turn: [0, 0, 0]' in text


@pytest.mark.parametrize('rpy', [
    (math.pi, 0, 0), (math.pi / 2, 0, -math.pi / 2), (0, math.pi / 2, 0), (0, 0, math.pi / 2),
    (0, 0, math.pi), (math.pi, 0, math.pi / 2)])
def test_the_axes_of_the_imu_are_found(inspect_drive, capsys, rpy):
    C_bi = matrix_from_rpy(rpy)
    small = matrix_from_rpy((0.0, 0.05, 0.08))    # small mounting angles do not matter
    seen, _ = inspect_drive(drive(C_ib=C_bi.T @ small.T))
    assert matrix_from_rpy(seen['mounting']['rpy']) == pytest.approx(C_bi, abs=1e-9)
    assert seen['mounting']['needed']
    assert seen['mounting']['deviation'] == pytest.approx(math.hypot(0.05, 0.08), abs=0.03)
    setting = shlex.split(seen['command'])[-1]
    assert setting.startswith('imu.mounting_rpy=[')
    # with this setting there is no finding on the axes
    seen, _ = inspect(seen['path'], capsys, '--set', setting)
    assert codes(seen) == {'YAW_NOT_SEPARABLE'}
    assert not seen['mounting']['needed']


def test_an_imu_turned_over_during_the_drive_is_not_a_wrong_unit(inspect_drive):
    upright, over = drive(), drive(C_ib=np.diag([1.0, -1.0, -1.0]))
    half = len(upright) // 2
    seen, text = inspect_drive(upright[:half] + over[half:])
    assert 'IMU_UNITS' not in codes(seen)
    assert 'gravity turns by 180 deg' in text


@pytest.mark.parametrize('rpy', [(0, 0, 0), (math.pi, 0, 0)])
def test_a_counter_that_counts_down_does_not_turn_the_imu(inspect_drive, rpy):
    """A whole recording is not driven backwards; the IMU would be set wrong by 180 deg."""
    C_bi = matrix_from_rpy(rpy)
    seen, _ = inspect_drive([(name, ns, make.whole(-message.data) if name == '/odometer'
                              else message)
                             for name, ns, message in drive(C_ib=C_bi.T)])
    assert matrix_from_rpy(seen['mounting']['rpy']) == pytest.approx(C_bi, abs=1e-9)
    assert 'odometer.reversed=true' in seen['command']


@pytest.mark.parametrize(('wrong', 'code', 'remedy_text'), [
    ({'accel': 1 / 9.80665}, 'IMU_UNITS', 'specific force is not in m/s^2 but in g'),
    ({'accel': 1 / 9.80665}, 'IMU_UNITS', '--set imu.accel_scale=9.80665'),
    ({'gyro': 180 / math.pi}, 'IMU_UNITS', f'--set imu.gyro_scale={math.pi / 180!r}'),
    ({'gyro': 2.0}, 'IMU_UNITS', 'IMU_UNITS: turns measured by the gyro are 2.'),
    ({'gyro': -1.0}, 'GYRO_SIGN', 'GYRO_SIGN'), ({'accel': -1.0}, 'GYRO_SIGN', 'GYRO_SIGN')])
def test_wrong_units_and_signs_are_found(inspect_drive, capsys, wrong, code, remedy_text):
    seen, text = inspect_drive(drive(**wrong))
    assert code in codes(seen)
    assert remedy_text in ' '.join(text.split())
    assert 'imu.mounting_rpy' not in seen['command'], 'no rotation corrects a sign'
    if wrong == {'gyro': 2.0}:
        assert seen['drive']['gyro_over_course'] == pytest.approx(2, abs=0.1)
        _, text = inspect(seen['path'], capsys, '--set', f'odometer.nominal_scale={4 * K}')
        assert 'typical for counting four edges per pulse (x4)' in ' '.join(text.split())


@pytest.mark.parametrize(('name', 'code', 'kind'), [
    ('/imu/data', 'NO_IMU', 'sensor_msgs/msg/Imu'),
    ('/odometer', 'NO_ODOMETER', 'std_msgs/msg/Int64'),
    ('/fix', 'NO_FIX', 'sensor_msgs/msg/NavSatFix')])
def test_a_topic_with_unreadable_messages_is_reported_as_missing(inspect_drive, name, code, kind):
    seen, text = inspect_drive([(topic, ns, b'' if topic == name else m) for topic, ns,
                                m in drive(60)],
                               types={name: kind})
    assert code in codes(seen)
    assert f'{code}: {name}: no message can be used: ' in ' '.join(text.split())
    assert 'under open sky' not in text


def test_counts_read_as_floats_give_no_warning(inspect_drive, recwarn):
    inspect_drive([(topic, ns, b'\0\1\0\0' + struct.pack('<q', m.data) if topic == '/odometer'
                    else m)
                   for topic, ns, m in drive(60)], types={'/odometer': 'std_msgs/msg/Float64'})
    assert not [one for one in recwarn if one.category is RuntimeWarning]


def test_topics_without_common_time_are_reported(inspect_drive):
    rows = drive(60)
    for name, _, message in rows:
        if name == '/imu/data':
            message.header.stamp = make.header(0).stamp
    seen, text = inspect_drive(rows)
    assert topic(seen, '/imu/data')['timing']['header_to_bag'] is None
    assert 'NO_IMU: none of the ' in text
    assert 'CLOCKS_DIFFER' not in codes(seen)
    seen, text = inspect_drive(drive(60, lag=8 * 3600.0))
    assert codes(seen) == {'CLOCKS_DIFFER'}
    assert 'have no time in common' in text
    seen, _ = inspect_drive(drive(lag=-3.0))
    assert 'CLOCKS_DIFFER' in codes(seen)
    assert topic(seen, '/fix')['timing']['header_to_bag'] == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize('name', ['/imu/data', '/fix'])
def test_stamps_without_the_fraction_of_a_second_are_reported(inspect_drive, name):
    """Those of a receiver with epochs at whole seconds are not."""
    rows = drive()
    at_seconds = [row for row in rows if row[0] != '/fix' or row[1] % 10**9 == 2]
    seen, text = inspect_drive(at_seconds)
    assert topic(seen, '/fix')['rate_hz'] == pytest.approx(1.0, rel=0.01)
    assert 'whole seconds' not in text
    for sent, _, message in rows:
        if sent == name:
            message.header.stamp.nanosec = 0
    seen, text = inspect_drive(rows)
    found = [t['name'] for t in seen['topics'] if t.get('timing', {}).get('whole_seconds')]
    assert found == [name]
    assert text.count('all stamps are whole seconds') == 1


def test_odd_stamps_and_gaps_are_counted(inspect_drive):
    rows = drive()
    imu = [i for i, row in enumerate(rows) if row[0] == '/imu/data']
    rows[imu[100]][2].header.stamp = make.header(0).stamp
    rows[imu[200]][2].header.stamp.sec -= 5         # backward, once
    rows[imu[301]] = (*rows[imu[301]][:2], rows[imu[300]][2])    # a row sent twice
    missing_rows = set(imu[2000:2600])                      # 12 s of IMU
    seen, text = inspect_drive([row for i, row in enumerate(rows) if i not in missing_rows])
    timing = topic(seen, '/imu/data')['timing']
    assert [timing[k] for k in ('zero_stamps', 'backward_steps', 'repeated_stamps')] == [1, 1, 1]
    longest = max(timing['gaps'], key=lambda gap: gap['length'])
    assert [longest['length'], longest['at']] == pytest.approx([600 / RATE, 2000 / RATE], abs=0.05)
    assert topic(seen, '/imu/data')['rate_hz'] == pytest.approx(RATE, rel=0.01)
    assert f'the longest of {longest["length"]:.2f} s at t = {longest["at"]:.2f} s' in text
    assert {'BAD_ROWS_DROPPED', 'STAMPS_NOT_RISING'} <= codes(seen)


def test_unusable_fixes_are_reported(inspect_drive):
    seen, text = inspect_drive(drive(status=-1))
    assert 'FIXES_UNUSABLE' in codes(seen)
    assert topic(seen, '/fix')['fix']['status'] == {'-1': 750}
    assert '750 no fix' in text
    seen, _ = inspect_drive(drive(known=0))
    assert topic(seen, '/fix')['fix']['sigma'] is None
    assert 'COVARIANCE_UNKNOWN' in codes(seen)
    seen, _ = inspect_drive([row for row in drive() if row[0] != '/fix'])
    assert [(f['text'], f['remedy']) for f in seen['findings'] if f['code'] == 'NO_FIX'] == [
        ('no topic for the fixes', 'Record sensor_msgs/NavSatFix, or name a topic of positions '
         'with --fix-topic.')]
    assert len(seen['standstills']) == 2            # found without fixes


@pytest.mark.filterwarnings('error')
def test_impossible_positions_are_not_counted(inspect_drive):
    rows = drive()
    fixes = (message for name, _, message in rows if name == '/fix')
    for latitude in (1e300, -1e308, np.inf, 91.0):
        next(fixes).latitude = latitude
    assert topic(inspect_drive(rows)[0], '/fix')['fix']['positions'] == 750 - 4


@pytest.mark.parametrize(('q', 'variance', 'words'), [
    ((0, 0, 0.6, 0.8), 1e-6, ''), ((0, 0, 0.6, 0.8), 0.01, 'uncertainty of 5.7 deg'),
    ((0, 0, 0.6, 0.8), 0.0, 'has no covariance'),
    ((0, 0, 0, 1), 0.0, 'publishes no orientation')])       # a default
def test_an_orientation_is_a_heading_or_the_reason_is_given(inspect_drive, q, variance, words):
    def oriented(ns, m):
        w, f = ((v.x, v.y, v.z) for v in (m.angular_velocity, m.linear_acceleration))
        return make.imu(ns, w=w, f=f, q=q, covariance=np.append(np.zeros(8), variance))
    seen, _ = inspect_drive([(name, ns, oriented(ns, m) if name == '/imu/data' else m)
                             for name, ns, m in drive()])
    texts = [f['text'] for f in seen['findings'] if f['code'] == 'YAW_NOT_SEPARABLE']
    assert bool(texts) == bool(words)
    assert words in ''.join(texts)


def test_loops_short_drives_and_invalid_values_are_reported(inspect_drive):
    seen, _ = inspect_drive(drive(loop=True))
    assert 'CHORD_TOO_SHORT' in codes(seen)
    assert seen['legs'][0]['chord'] < 5
    rows = drive(30)
    at = next(i for i, row in enumerate(rows) if i > 5 and row[0] == '/imu/data')
    rows[at] = ('/imu/data', rows[at][1], make.imu(rows[at][1], w=(math.nan, 0, 0)))
    seen, _ = inspect_drive(rows)
    assert 'LEG_TOO_SHORT' not in codes(seen) or seen['legs'][0]['distance'] < 100
    assert topic(seen, '/imu/data')['imu']['not_finite'] == 1
    assert 'no valid value' in inspect_drive([('/speed', T0 + i, make.real(math.nan))
                                              for i in range(5)])[1]
    assert inspect_drive([row for row in drive(1) if row[1] < T0 + 3])[0]['messages'] == 3


def test_two_wheels_on_two_topics_are_found(inspect_drive):
    seen, _ = inspect_drive([row for name, ns, m in drive() for row in (
        [('/ticks/left', ns, m), ('/ticks/right', ns, m)] if name == '/odometer'
        else [(name, ns, m)])])
    assert seen['mapping']['odometer_right'] == '/ticks/right'
    assert seen['command'].endswith('--set odometer.left=topic --set odometer.right=topic')


def test_a_topic_named_by_the_user_is_used(inspect_drive, capsys):
    rows = drive(20) + [('/speed', T0 + i * 10**8, make.twist_stamped(T0 + i * 10**8, 1.0))
                        for i in range(200)]
    seen, _ = inspect_drive(sorted(rows, key=lambda row: row[1]))
    path = seen['path']
    assert seen['mapping']['odometer'] == '/odometer'     # preferred to a speed
    assert '2 topics can be the odometer' in seen['replay_error']
    assert '--odometer-topic /odometer' in seen['command']
    seen, _ = inspect(path, capsys, '--odometer-topic', 'speed')
    assert seen['mapping']['odometer'] == '/speed'
    assert '--odometer-topic /speed' in seen['command']
    for option, topic_, words in (('--fix-topic', '/gps', ' --fix-topic /gps: no such topic'),
                                  ('--imu-topic', '/fix', 'which cannot be used as IMU')):
        assert main(['inspect', path, option, topic_]) == 2
        assert words in capsys.readouterr().err


def test_a_drive_is_screened_once(inspect_drive, capsys, monkeypatch):
    """The legs are found in samples already screened: without the screen nothing changes."""
    expected = inspect_drive(drive())
    assert expected[0]['legs']
    monkeypatch.setattr(find_legs, 'screen', None)
    assert inspect(expected[0]['path'], capsys) == expected


def test_a_counter_that_stops_gives_no_scale_and_no_axes(inspect_drive):
    seen, text = inspect_drive([(topic, ns, make.whole(700) if topic == '/odometer'
                                 and ns > T0 + 60e9 else raw) for topic, ns, raw in drive()])
    assert 'ODOMETER_STILL' in codes(seen)
    assert seen['drive'] is None
    assert 'scale factor' not in text
    assert 'imu.mounting_rpy' not in text
