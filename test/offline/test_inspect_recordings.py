# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect on real drives, on bags that hold none, and on the wheels in lists of values."""

from itertools import count
import json
import math

import inspect_output
from inspect_output import codes, inspect, planar, RATE, topic
import numpy as np
import pytest
import ros_bags
import ros_messages as make

from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow


def test_inspect_finds_topics_axes_and_motion_of_a_car_of_comma2k19(data_dir, capsys):
    path = data_dir / 'comma2k19_rav4' / 'bag'
    seen, text = inspect(path, capsys)
    assert seen['mapping'] == {'odometer': '/odometer/pulses_derived', 'imu': '/imu/data',
                               'fix': '/fix'}
    assert codes(seen) == {'COVARIANCE_UNKNOWN', 'IMU_LOOKS_Z_DOWN', 'NO_STANDSTILL',
                           'YAW_NOT_SEPARABLE'}
    assert seen['standstills'] == []
    assert seen['drive']['slowest'] > 7.9          # README: 8 to 20 m/s, never at rest
    assert seen['drive']['distance'] == pytest.approx(1004, rel=0.01)
    assert seen['drive']['rough_scale'] == pytest.approx(0.010084, rel=0.005)
    # README: forward-right-down, pitch 3.75 deg on top
    assert seen['mounting']['rpy'] == pytest.approx([math.pi, 0, 0], abs=1e-9)
    assert seen['mounting']['needed']
    assert not seen['mounting']['assumed_forward']
    imu = topic(seen, '/imu/data')
    assert imu['rate_hz'] == pytest.approx(104.3, abs=0.1)
    assert (imu['imu']['gravity_axis'], imu['imu']['orientation']) == ('-z', False)
    assert topic(seen, '/imu/data_flu')['imu']['gravity_axis'] == '+z'
    fix = topic(seen, '/fix')
    assert fix['fix']['sigma'] is None
    assert fix['timing']['header_to_bag'] == pytest.approx(0.20, abs=0.01)
    pulses = topic(seen, '/odometer/pulses_derived')
    assert pulses['timing']['headerless']
    assert (pulses['odometer']['quantity'], pulses['rate_hz']) == (
        'cumulative', pytest.approx(82.9, abs=0.1))
    for line in ('the IMU z axis points down', 'no header: arrival time', 'arrival jitter',
                 'never at rest', 'no covariance', '3 topics can be the odometer',
                 '[3.141592654, 0, 0] rad'):
        assert line in text


def test_inspect_finds_mounting_and_straight_sides_of_a_husky_drive(data_dir, capsys):
    path = data_dir / 'husky_parking_lot' / 'bag'
    seen, text = inspect(path, capsys)
    assert seen['mounting']['rpy'] == pytest.approx([math.pi / 2, 0, -math.pi / 2], abs=1e-9)
    assert not seen['mounting']['assumed_forward']
    imu = topic(seen, '/imu/data')['imu']
    assert (imu['gravity_axis'], imu['orientation']) == ('+y', True)
    assert topic(seen, '/fix')['rate_hz'] == pytest.approx(2.5, abs=0.01)
    (start, stop), = seen['standstills']           # README: one stop of 11 s
    assert stop - start == pytest.approx(11, abs=1)
    leg, = seen['legs']
    assert leg['chord'] < 0.1 * leg['distance']         # a closed loop
    assert leg['distance'] == pytest.approx(0.98 * 359, rel=0.02)
    assert {'CHORD_TOO_SHORT', 'SPEED_TOO_LOW', 'IMU_AXES', 'YAW_NOT_SEPARABLE'} <= codes(seen)
    assert seen['drive']['gyro_over_course'] == pytest.approx(1, abs=0.2)
    # its counts, at the 0.980 mm of its README: 0.996 m in the fastest second
    assert seen['drive']['fastest'] == pytest.approx(0.996, rel=0.013)
    assert len(seen['straight']) == 2              # the long sides of 145 x 70 m
    assert all(leg['chord'] > 0.9 * leg['distance'] for leg in seen['straight'])
    # the whole drive gives the smoother more than its straight sides: 1.7 % instead of 3.3 %
    assert '--leg' not in seen['command']
    alone = text[text.index('for the two-point method only'):]
    for code in ('NO_STANDSTILL', 'CHORD_TOO_SHORT', 'YAW_NOT_SEPARABLE'):
        assert text.count(f'{code}:') == alone.count(f'{code}:') == 1
    seen, text = inspect(path, capsys, '--set', 'method=two_point')
    assert '--leg' in seen['command']
    assert 'mounted on its side' in text
    assert 'for the two-point method only' not in text


@pytest.mark.parametrize('name', ['talker_mcap', 'cdr_test_mcap', 'service_events_mcap',
                                  'split3_sqlite3_no_metadata', 'split5_mcap'])
def test_inspect_of_bags_without_any_input_names_what_is_missing(data_dir, capsys, name):
    seen, text = inspect(data_dir / 'reader_bags' / name, capsys)
    assert codes(seen) == {'NO_IMU', 'NO_ODOMETER', 'NO_FIX'}
    assert seen['command'] == ''
    assert 'odocal replay without options stops with:\n  no odometer' in text
    unwrapped = ' '.join(text.split())       # a long path moves the line breaks
    assert ('metadata.yaml is missing' in unwrapped) == ('no_metadata' in name)


WIDTH, RADIUS = 1.6, 0.3      # m


def drive(message):
    """Return rows of the planar drive; message(ns, i, left, right) gives an odometer, rad."""
    _, v, w, _ = planar()
    left, right = (np.cumsum(v - s * w * WIDTH / 2) / RATE / RADIUS for s in (1, -1))
    number = count()
    return [('/wheels', ns, message(ns, i := next(number), left[i], right[i]))
            if name == '/odometer' else (name, ns, m) for name, ns, m in inspect_output.drive()]


@pytest.fixture
def inspect_drive(tmp_path, capsys):
    """Return a function that gives findings, wheels and text of a drive with an odometer."""
    def inspected(message):
        path = ros_bags.write(tmp_path / 'bag', drive(message))
        facts, text = inspect(path, capsys)
        return facts, topic(facts, '/wheels'), text
    return inspected


def test_times_are_those_of_the_stamps_if_they_are_on_another_clock(tmp_path, capsys):
    """In simulation time, seconds from the first message of the bag would be negative."""
    rows = drive(lambda ns, _, left, right: make.joints(ns, ['left', 'right'], [left, right]))
    (usual, _), (other, _) = (inspect(ros_bags.write(tmp_path / name, [
        (topic, ns + later, message) for topic, ns, message in rows]), capsys)
        for name, later in (('bag', 0), ('other', 10**16)))
    # the last topic begins 0.4 s after the first message
    assert other['standstills'] == [pytest.approx(span, abs=0.5) for span in usual['standstills']]
    assert [leg['start'] for leg in other['legs']] == [
        pytest.approx(leg['start'], abs=0.5) for leg in usual['legs']]


def test_the_sides_of_unnamed_joints_are_found_from_their_motion(inspect_drive):
    names = ['j1', 'j2', 'j3']
    printed, wheels, text = inspect_drive(lambda ns, i, left, right: make.joints(
        ns, names, [0.4 * np.sin(i / 30), right, left]))
    assert [v['side'] for v in wheels['values']] == ['', 'right', 'left']
    assert [v['rolls'] for v in wheels['values']] == [False, True, True]
    assert 'the wheels among the joints j1, j2, j3 are not clear' in wheels['error']
    assert printed['command'].endswith('--set odometer.left=j3 --set odometer.right=j2')
    assert 'j1 travels' in text


def test_four_unnamed_joints_are_a_list_of_axles(inspect_drive):
    found, wheels, _ = inspect_drive(lambda ns, i, left, right: make.joints(
        ns, ['a', 'b', 'c', 'd'], [right, left, 1.01 * right, 0.99 * left]))
    assert [v['side'] for v in wheels['values']] == ['right', 'left', 'right', 'left']
    assert found['command'].endswith("--set 'odometer.wheels=[b, a, d, c]'")


def test_the_sides_of_two_counters_are_found_and_replay_runs(inspect_drive, tmp_path, capsys):
    printed, wheels, _ = inspect_drive(lambda ns, i, left, right: (
        make.whole_array([int(right * 50), int(left * 50)])))
    assert 'the mean of 0 and 1 is used' in wheels['chosen']
    options = ['--set', 'odometer.left=1', '--set', 'odometer.right=0']
    assert printed['command'].split()[-4:] == options
    assert main(['replay', printed['path'], *options, '--output', str(tmp_path / 'out'), '--json',
                 '--set', 'output.formats=[params]']) < 2
    stdout = capsys.readouterr().out
    assert 'scale_factor_left' in json.loads(stdout)['methods']['smoother']['estimates']
    assert 'WHEELS_SWAPPED' not in stdout


def test_wheels_found_by_their_names_are_shown_with_their_settings(inspect_drive):
    names = ['left_steer', 'left_wheel', 'right_steer', 'right_wheel']
    found, wheels, _ = inspect_drive(lambda ns, i, left, right: make.joints(
        ns, names, velocity=[0.1, left, 0.1, right]))
    assert 'left_wheel is used as left wheel, right_wheel as right' in wheels['chosen']
    assert found['command'].endswith(
        '--set odometer.left=left_wheel --set odometer.right=right_wheel')
    assert 'error' not in wheels
