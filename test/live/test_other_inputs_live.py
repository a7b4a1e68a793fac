# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs by poses, skid steering, two or four wheels, air pressure; journals replay to the bit."""

import re
from types import SimpleNamespace

from bench import given, wait_for
from kills import check_replay
from player import leg_of, messages_of, part, playing_to
import pytest

from odocal_ros.bagio import encode
from odocal_ros.live.answers import TURNS
from odocal_ros.sim.scenarios import SimOptions, simulate
from odocal_ros.sim.wheels import effective_width

SIGMAS = 4.0             # 1 in 16 000 of a normal error; the seeds are fixed
SPEED = 30.0
REST_S = 30.0            # of the drive played before the mark


def driven(folder, options, topics, settings=lambda drive: {}, **more):
    """Simulate and drive one leg; return its results and the drive."""
    drive = simulate(SimOptions(**options))
    wanted = {'output.directory': folder, 'leg.preroll': 20.0} | settings(drive)
    seen = leg_of(drive, messages_of(drive, **topics(drive)), wanted, **more)
    assert seen.stop.success, seen.stop.message
    return SimpleNamespace(drive=drive, **vars(seen))


def joints(drive):
    return dict(zip(drive.joints, drive.wheels, strict=True))


@pytest.fixture(scope='module')
def posed(tmp_path_factory):
    """Drive two minutes of town with poses on the topic fix."""
    return driven(tmp_path_factory.mktemp('posed'), {
        'scenario': 'town', 'duration': 200.0, 'imu_rate': 50.0, 'odometer_rate': 25.0,
        'odometer': 'speed', 'fix_noise': 'rtk', 'reference': 'pose', 'seed': 4},
        lambda drive: {'fix': encode.pose('pose', drive.fix, drive.positions())},
        names={'fix': '/slam/pose'})


@pytest.fixture(scope='module')
def skid(tmp_path_factory):
    """Drive 90 s of a robot with two wheels that slide in turns."""
    return driven(tmp_path_factory.mktemp('skid'), {
        'scenario': 'indoor', 'duration': 90.0, 'imu_rate': 50.0, 'drive': 'skid',
        'odometer': 'angle', 'odometer_rate': 25.0, 'reference': 'mocap', 'fix_rate': 10.0,
        'slip_walk': 5e-4, 'seed': 3},
        lambda drive: {'odometer': encode.joints('joint_states', joints(drive)),
                       'fix': encode.pose('mocap', drive.fix, drive.positions())},
        lambda drive: {'odometer.drive': 'skid', 'odometer.left': drive.joints[0],
                       'odometer.right': drive.joints[1]},
        rest_s=4.0, leg_s=80.0, speed=20.0, names={'fix': '/mocap', 'odometer': '/joint_states'})


@pytest.fixture(scope='module')
def bare(tmp_path_factory):
    """Drive 90 s of a robot with two wheels and motion capture, without an IMU."""
    return driven(tmp_path_factory.mktemp('bare'), {
        'scenario': 'indoor', 'duration': 110.0, 'imu': False, 'odometer': 'angle',
        'odometer_rate': 25.0, 'reference': 'mocap', 'fix_rate': 10.0, 'slip_walk': 5e-4,
        'seed': 3},
        lambda drive: {'imu': None,
                       'odometer': encode.joints('joint_states', joints(drive)),
                       'fix': encode.pose('mocap', drive.fix, drive.positions())},
        lambda drive: {'odometer.left': drive.joints[0], 'odometer.right': drive.joints[1]},
        rest_s=4.0, leg_s=100.0, speed=10.0, names={'fix': '/mocap', 'odometer': '/joint_states'})


@pytest.fixture(scope='module')
def four(tmp_path_factory):
    """Drive some minutes of town with four wheels, two of which steer, and air pressure."""
    return driven(tmp_path_factory.mktemp('four'), {
        'scenario': 'town', 'duration': 240.0, 'imu_rate': 50.0, 'odometer_rate': 25.0,
        'fix_noise': 'rtk', 'imu_grade': 'tactical', 'wheels': 4, 'heading': 0.7, 'seed': 4,
        'pressure_sigma': 0.15},
        lambda drive: {'pressure': encode.pressure('pressure', drive.pressure),
                       'odometer': encode.joints('odometer', {
                           'steering': drive.odometer, **joints(drive)})},
        lambda drive: {'method': 'smoother', 'imu.grade': 'tactical',
                       'odometer.wheels': f'[{", ".join(drive.joints)}]'},
        rest_s=30.0, leg_s=160.0)


@pytest.mark.parametrize('leg', ['posed', 'skid', 'bare', 'four'])
def test_a_journal_replays_to_the_last_bit(leg, request):
    seen = request.getfixturevalue(leg)
    assert 'no NavSatFix' not in check_replay(seen.live, seen.journal)    # it names its topics
    assert 'Traceback' not in seen.node.text


def test_a_leg_with_poses_finds_the_truth(posed):
    assert 'fix: geometry_msgs/msg/PoseStamped on /slam/pose, best effort' in posed.node.text
    scale = posed.live['result']['scale_factor']
    assert abs(scale['value'] - posed.drive.truth.scale) < SIGMAS * scale['sigma'] < 0.004
    assert 'LOCAL_FRAME' in {r['code'] for r in posed.live['legs'][0]['reasons']}
    assert posed.live['inputs'][0]['topics']['fix'] == '/slam/pose'


def test_skid_steering_gives_the_effective_width(skid):
    width = skid.live['result']['track_width']
    assert width['method'] == 'planar'
    true = effective_width(skid.drive.options)
    assert abs(width['value'] - true) < SIGMAS * width['sigma'] < 0.02 * true


def test_a_robot_without_an_imu_is_calibrated_by_its_wheels(bare):
    assert bare.live['verdict'] == 'accepted'
    assert 'imu' not in bare.live['inputs'][0]['topics']
    assert 'not observable: yaw and pitch (no IMU)' in bare.node.text
    for side, true in zip(('left', 'right'), bare.drive.truth.wheel_scales, strict=True):
        scale = bare.live['result'][f'scale_factor_{side}']
        assert scale['method'] == 'planar'
        assert abs(scale['value'] - true) < SIGMAS * scale['sigma'] < 0.004 * true
    width, true = bare.live['result']['track_width'], bare.drive.options.track_width
    assert abs(width['value'] - true) < SIGMAS * width['sigma'] < 0.01 * true
    assert (bare.status['scale_ok'], bare.status['yaw_ok']) == ('yes', 'unknown')
    assert 'no forecast for the leg' not in bare.node.text


def test_status_and_answer_have_each_of_four_wheels_by_its_name(four):
    for name, true in zip(four.drive.joints, four.drive.truth.wheel_scales, strict=True):
        assert f', {name} 0.3' in four.stop.message
        value, sigma = (float(four.status[f'scale_factor_{name}{end}']) for end in ('', '_sigma'))
        assert abs(value - true) < SIGMAS * sigma
        assert four.live['result'][f'scale_factor_{name}']['value'] == value
    assert four.status['left_right_ok'] == 'unknown'
    assert 'WHEELS_STEERED' in four.status['reasons']
    seen = four.live['legs'][0]['methods']['smoother']['outside']['pressure']
    assert seen['messages'] > 150       # means of a second


def test_an_imu_is_required_if_it_is_published(start, connect):
    """A node with two wheels does not ask for an IMU until somebody publishes one."""
    from sensor_msgs.msg import Imu
    start('-p', 'odometer.left:=left', '-p', 'odometer.right:=right')
    client = connect()
    missing = client.until(state='waiting')['missing']
    assert 'no odometer on /odometer' in missing
    assert '/imu/data' not in missing
    client.node.create_publisher(Imu, '/imu/data', 1)
    wait_for(lambda: '/imu/data: 1 publisher found (reliable) but no message yet'
             in client.status['missing'], 'the IMU in the status')


def test_one_topic_is_not_odometer_and_reference(start):
    node = start('-r', 'fix:=/odom', '-r', 'odometer:=/odom')
    assert node.wait() != 0
    assert ('/odom is both odometer and fix: an odometer cannot be calibrated against itself; '
            'remap one of them to another topic') in node.text
    assert 'Traceback' not in node.text


def test_an_odometry_is_the_reference_where_the_name_is_remapped(start, connect):
    from nav_msgs.msg import Odometry
    node = start('-r', 'fix:=/lidar/odometry')
    connect().node.create_publisher(Odometry, '/lidar/odometry', 1)
    wait_for(lambda: 'fix: nav_msgs/msg/Odometry on /lidar/odometry' in node.text,
             'a subscription')


@pytest.fixture(scope='module')
def drive():
    return simulate(SimOptions(
        scenario='town', duration=240.0, imu_rate=50.0, odometer_rate=25.0, fix_noise='rtk',
        imu_grade='tactical', odometer='angle', two_wheels=True, heading=0.7, seed=4))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    folder = tmp_path_factory.mktemp('two')
    # no setting says which joints are the wheels: their names do
    wheels = {'left_steering': drive.odometer_right, 'right_steering': drive.odometer,
              'wheel_left': drive.odometer, 'wheel_right': drive.odometer_right}
    types, sent = messages_of(drive, odometer=encode.joints('odometer', wheels))
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    settings = {'output.directory': folder, 'method': 'wheels',
                'alignment.heading': drive.truth.heading, 'alignment.heading_sigma': 0.002,
                'wheels.radius': 0.3, 'imu.grade': 'tactical'}
    seen = SimpleNamespace()
    with playing_to(types, *given(settings)) as (_, client, player):
        player.play(part(sent, start_s - REST_S, start_s), SPEED)
        seen.idle = client.until(state='idle')
        seen.start = client.call('start_leg')
        seen.first = client.until(state='recording')
        player.play(part(sent, start_s, start_s + 160), SPEED)
        seen.looked = wait_for(
            lambda: client.status['track_width_ok'] != 'unknown' and client.status,
            'a look at the wheels')
        stopping = client.ask('stop_leg')
        client.until(state='computing')
        player.play(part(sent, start_s + 160, start_s + 163), SPEED)
        # inputs that are silent while it is computed would be the hint
        with player.playing(part(sent, start_s + 163, 240), 1.0):
            seen.stop = client.result(stopping)
            seen.result = wait_for(lambda: client.status['state'] in ('calibrated', 'rejected')
                                   and client.status, 'the result')
        yield seen


def test_the_start_says_what_to_drive_and_what_it_can_tell(session):
    assert session.start.success
    text = session.start.message
    assert re.search(r'drive 1?\d\d m more, faster than leg.min_speed, 2.78 m/s \(10 km/h\), ',
                     text)
    assert TURNS in text
    assert 'until this hint shows OK for scale and yaw' in text
    assert text.endswith(
        'With these settings, observable: the scale, the yaw (from stops, starts and turns), '
        'the pitch, left and right wheel and the track width (in turns)')
    assert session.first['hint'].split(', ', 1)[1] in text        # the same text in the status
    assert session.first['can_tell'].startswith('the scale, the yaw (from')
    assert (session.first['cannot_tell'], session.first['track_width_ok']) == ('', 'unknown')
    assert TURNS in session.first['manoeuvres']


def test_while_it_is_driven_each_quantity_is_yes_or_no(session):
    seen = session.looked
    assert seen['state'] == 'recording'
    found = {name: seen[f'{name}_ok'] for name in (
        'scale', 'yaw', 'pitch', 'left_right', 'track_width')}
    assert set(found.values()) <= {'yes', 'no'}
    assert (found['track_width'] == 'yes') == (TURNS not in seen['hint'])


def test_the_stop_answers_with_both_wheels_and_how_good_each_quantity_is(session, drive):
    assert session.stop.success
    text, status = session.stop.message, session.result
    for words in ('scale factor 0.', ', left 0.', ', right 0.', ', track width 1.', ' OK: scale'):
        assert words in text, text
    assert status['hint'] in text                                 # the same text in the status
    truth = drive.truth
    for name, true in zip(('left', 'right'), truth.wheel_scales, strict=True):
        value, sigma = (float(status[f'scale_factor_{name}{end}']) for end in ('', '_sigma'))
        assert abs(value - true) < 4 * sigma        # 1 in 16000 by chance
    width, sigma = float(status['track_width_m']), float(status['track_width_sigma_m'])
    assert abs(width - drive.options.track_width) < 4 * sigma
    assert (status['left_right_ok'], status['track_width_ok']) == ('yes', 'yes')
    assert 'OK: scale' in status['message']
