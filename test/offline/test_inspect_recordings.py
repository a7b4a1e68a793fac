# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect on real drives, and on bags that hold none."""

import math

from inspect_output import codes, inspect, topic
import pytest

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
    for line in ('looks z-down', 'no header: arrival time', 'arrival jitter', 'never at rest',
                 'no covariance', '3 topics can be the odometer', '[3.141592654, 0, 0] rad'):
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
