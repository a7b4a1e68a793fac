# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs with two wheels, without an IMU, and with four wheels."""

import re
from types import SimpleNamespace

from bench import wait_for
from kills import check_replay
from player import leg_of, messages_of, playing_to, within
import pytest

from odocal_ros.bagio import encode
from odocal_ros.live.answers import TURNS
from odocal_ros.sim.scenarios import SimOptions, simulate

INDOOR = {'scenario': 'indoor', 'odometer': 'angle', 'odometer_rate': 25.0, 'reference': 'mocap',
          'fix_rate': 10.0, 'slip_walk': 5e-4, 'seed': 3}
NAMES = {'fix': '/mocap', 'odometer': '/joint_states'}


def joints(drive, **more):
    return encode.joints('joint_states', more | dict(zip(drive.joints, drive.wheels, strict=True)))


def indoor(drive):
    return {'odometer': joints(drive), 'imu': None,
            'fix': encode.pose('mocap', drive.fix, drive.positions())}


def sides(drive):
    return {'odometer.left': drive.joints[0], 'odometer.right': drive.joints[1]}


@pytest.fixture(scope='module')
def bare(tmp_path_factory):
    """Drive a robot with two wheels and motion capture, without an IMU."""
    return leg_of(tmp_path_factory.mktemp('bare'), INDOOR | {'duration': 110.0, 'imu': False},
                  indoor, sides, rest_s=4.0, leg_s=100.0, speed=10.0, names=NAMES)


@pytest.fixture(scope='module')
def four(tmp_path_factory):
    """Drive some minutes of town with four wheels, two of which steer, and air pressure."""
    return leg_of(tmp_path_factory.mktemp('four'), {
        'scenario': 'town', 'duration': 240.0, 'imu_rate': 50.0, 'odometer_rate': 25.0,
        'fix_noise': 'rtk', 'imu_grade': 'tactical', 'wheels': 4, 'heading': 0.7, 'seed': 4,
        'pressure_sigma': 0.15},
        lambda drive: {'pressure': encode.pressure('pressure', drive.pressure),
                       'odometer': joints(drive, steering=drive.odometer)},
        lambda drive: {'method': 'smoother', 'imu.grade': 'tactical',
                       'odometer.wheels': f'[{", ".join(drive.joints)}]'},
        rest_s=30.0, leg_s=160.0)


@pytest.mark.parametrize('leg', ['bare', 'four'])
def test_the_replay_of_a_journal_is_identical(leg, request):
    seen = request.getfixturevalue(leg)
    assert 'no NavSatFix' not in check_replay(seen.live, seen.journal)    # topics are known
    assert 'Traceback' not in seen.node.text


def test_a_robot_without_an_imu_is_calibrated_by_its_wheels(bare):
    assert bare.live['verdict'] == 'accepted'
    assert 'imu' not in bare.live['inputs'][0]['topics']
    assert 'not observable: yaw and pitch (no IMU)' in bare.node.text
    left, right = bare.drive.truth.wheel_scales
    for name, true, most in (('scale_factor_left', left, 0.004),
                             ('scale_factor_right', right, 0.004),
                             ('track_width', bare.drive.options.track_width, 0.01)):
        found = bare.live['result'][name]
        assert found['method'] == 'planar'
        assert within(found, true), name
        assert 4 * found['sigma'] < most * true, name
    assert (bare.status['scale_ok'], bare.status['yaw_ok']) == ('yes', 'unknown')
    assert 'no forecast for the leg' not in bare.node.text


def test_status_and_answer_name_each_of_four_wheels(four):
    for name, true in zip(four.drive.joints, four.drive.truth.wheel_scales, strict=True):
        assert f', {name} 0.3' in four.stop.message
        found = four.live['result'][f'scale_factor_{name}']
        assert within(found, true)
        assert [float(four.status[f'scale_factor_{name}{end}']) for end in ('', '_sigma')] == [
            found['value'], found['sigma']]
    assert four.status['left_right_ok'] == 'unknown'
    assert 'WHEELS_STEERED' in four.status['reasons']
    seen = four.live['legs'][0]['methods']['smoother']['external']['pressure']
    assert seen['messages'] > 150       # means over 1 s


def test_an_imu_is_required_if_it_is_published(start, connect):
    """A node with two wheels does not require an IMU until one is published."""
    from sensor_msgs.msg import Imu
    start({'odometer.left': 'left', 'odometer.right': 'right'})
    client = connect()
    missing = client.until(state='waiting')['missing']
    assert 'no odometer on /odometer' in missing
    assert '/imu/data' not in missing
    client.node.create_publisher(Imu, '/imu/data', 1)
    wait_for(lambda: '/imu/data: 1 publisher found (reliable) but no message yet'
             in client.status['missing'], 'the IMU in the status')


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """Drive a leg with two wheels, and keep the messages of the node."""
    drive = simulate(SimOptions(
        scenario='town', duration=240.0, imu_rate=50.0, odometer_rate=25.0, fix_noise='rtk',
        imu_grade='tactical', odometer='angle', two_wheels=True, heading=0.7, seed=4))
    # the wheels are chosen by the names of the joints, without a setting
    wheels = {'left_steering': drive.odometer_right, 'right_steering': drive.odometer,
              'wheel_left': drive.odometer, 'wheel_right': drive.odometer_right}
    driven = messages_of(drive, odometer=encode.joints('odometer', wheels))
    start_s = (drive.leg().start_ns - driven[1][0].stamp_ns) * 1e-9
    settings = {'output.directory': tmp_path_factory.mktemp('two'), 'method': 'wheels',
                'alignment.heading': drive.truth.heading, 'alignment.heading_sigma': 0.002,
                'wheels.radius': 0.3, 'imu.grade': 'tactical'}
    seen = SimpleNamespace(drive=drive)
    with playing_to(driven, settings) as leg:
        client = leg.client
        leg.play(start_s - 30.0, start_s)
        client.until(state='idle')
        seen.start = client.call('start_leg')
        seen.first = client.until(state='recording')
        leg.play(start_s, start_s + 160)
        seen.looked = wait_for(
            lambda: client.status['track_width_ok'] != 'unknown' and client.status,
            'a look at the wheels')
        stopping = client.ask('stop_leg')
        client.until(state='computing')
        leg.play(start_s + 160, start_s + 163)
        # inputs without messages during the computation would change the hint
        with leg.playing(start_s + 163, 240, 1.0):
            seen.stop = client.result(stopping)
            seen.result = wait_for(lambda: client.status['state'] in ('calibrated', 'rejected')
                                   and client.status, 'the result')
        return seen


def test_the_start_answers_with_the_manoeuvres_and_the_observable_values(session):
    assert session.start.success
    text = session.start.message
    assert re.search(r'drive 1?\d\d m more, faster than leg.min_speed, 2.78 m/s \(10 km/h\), ',
                     text)
    assert TURNS in text
    assert 'until this hint shows OK for scale and yaw' in text
    assert text.endswith(
        'With these settings, observable: the scale, the yaw (from stops, starts and turns), '
        'the pitch, left and right wheel and the track width (needs turns)')
    assert session.first['hint'].split(', ', 1)[1] in text        # the same text in the status
    assert session.first['observable'].startswith('the scale, the yaw (from')
    assert (session.first['not_observable'], session.first['track_width_ok']) == ('', 'unknown')
    assert TURNS in session.first['manoeuvres']


def test_each_quantity_is_yes_or_no_in_the_status_during_the_leg(session):
    seen = session.looked
    assert seen['state'] == 'recording'
    assert {seen[f'{name}_ok'] for name in ('scale', 'yaw', 'pitch', 'left_right', 'track_width')
            } <= {'yes', 'no'}
    assert (seen['track_width_ok'] == 'yes') == (TURNS not in seen['hint'])


def test_the_stop_answers_with_both_wheels_and_the_quality_of_each_quantity(session):
    assert session.stop.success
    text, status = session.stop.message, session.result
    for words in ('scale factor 0.', ', left 0.', ', right 0.', ', track width 1.', ' OK: scale'):
        assert words in text, text
    assert status['hint'] in text                                 # the same text in the status
    left, right = session.drive.truth.wheel_scales
    for name, unit, true in (('scale_factor_left', '', left), ('scale_factor_right', '', right),
                             ('track_width', '_m', session.drive.options.track_width)):
        value, sigma = (float(status[f'{name}{end}{unit}']) for end in ('', '_sigma'))
        assert within({'value': value, 'sigma': sigma}, true), name
    assert (status['left_right_ok'], status['track_width_ok']) == ('yes', 'yes')
    assert 'OK: scale' in status['message']
