# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs with poses, TF or ~/mark on points as reference; their journals replay identically."""

import importlib.util
from types import SimpleNamespace

from bench import wait_for
from kills import check_replay
import numpy as np
from player import leg_of, messages_of, playing_to, Sent, within
import pytest
import ros_messages as make

from odocal_ros.bagio import encode
from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.library.calibrate_bag import calibrate_bag
from odocal_ros.live.messages import message_class
from odocal_ros.sim.scenarios import SimOptions, simulate

TF = 'tf2_msgs/msg/TFMessage'
TOWN = {'scenario': 'town', 'duration': 200.0, 'imu_rate': 50.0, 'odometer_rate': 25.0,
        'odometer': 'speed', 'fix_noise': 'rtk', 'reference': 'pose', 'seed': 4}
POINTS = (0, 0, 4, 0, 4, 4, 0, 4, 0, 0, 4, 0, 4, -4, 0, -4, 0, 0)
TIMES = (5.0, *(20.5 + 17.0 * k for k in range(8)))     # in the middle of 3 s at rest


@pytest.fixture(scope='module')
def posed(tmp_path_factory):
    """Drive two minutes of town with poses on the topic fix."""
    return leg_of(
        tmp_path_factory.mktemp('posed'), TOWN,
        lambda drive: {'fix': encode.pose('pose', drive.fix, drive.positions())},
        names={'fix': '/slam/pose'})


def transforms(t_ns, place, child, frame):
    return [Sent(int(t), 'fix', make.cdr(make.kind(TF)(transforms=[
        make.transform(int(t), p, child, frame)]))) for t, p in zip(t_ns, place, strict=True)]


@pytest.fixture(scope='module')
def tf(tmp_path_factory):
    """Drive the same with TF: odom drifts by 0.1 m/s, SLAM corrects it."""
    messages = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed')
    from rclpy.qos import DurabilityPolicy, QoSProfile
    drive = simulate(SimOptions(**TOWN))
    types, sent = messages_of(drive, fix=None)
    t_fix, t = drive.fix.stamp_ns, drive.odometer.stamp_ns

    def drift(at_ns):
        return np.outer((at_ns - t[0]) * 1e-10, [1.0, 0.0, 0.0])
    sent += transforms(t_fix, drive.positions() - drift(t_fix), 'odom', 'map')
    sent += transforms(t, drift(t), 'base_link', 'odom')
    driven = types | {'fix': TF}, sorted(sent, key=lambda one: one.stamp_ns)
    # a quarter turn, which does not change the positions
    fixed = make.transform(0, (0.0, 0.0, 0.0), 'prism', 'base_link')
    fixed.transform.rotation.z = fixed.transform.rotation.w = 0.5 ** 0.5
    start_s = (drive.leg().start_ns - driven[1][0].stamp_ns) * 1e-9
    settings = {'output.directory': tmp_path_factory.mktemp('tf'), 'leg.preroll': 20.0,
                'reference.frames': '[map, prism]'}
    with playing_to(driven, settings, names={'fix': '/tf'}) as leg:
        publisher = leg.client.node.create_publisher(
            messages.TFMessage, '/tf_static',
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        publisher.publish(make.cdr(make.kind(TF)(transforms=[fixed])))
        wait_for(publisher.get_subscription_count, 'a subscription to /tf_static')
        leg.record(start_s - 60, start_s, start_s + 150)
        return SimpleNamespace(drive=drive, **vars(leg.stopped(start_s + 150, 3.0)))


@pytest.mark.parametrize(('leg', 'words'), [
    ('posed', 'fix: geometry_msgs/msg/PoseStamped on /slam/pose, best effort'),
    ('tf', 'fix: tf2_msgs/msg/TFMessage on /tf, best effort')])
def test_a_leg_with_a_position_reference_is_accurate_and_replays_identically(leg, words, request):
    seen = request.getfixturevalue(leg)
    assert words in seen.node.text
    assert 'Traceback' not in seen.node.text
    assert seen.stop.success, seen.stop.message
    scale = seen.live['result']['scale_factor']
    assert within(scale, seen.drive.truth.scale)
    assert 4 * scale['sigma'] < 0.004
    assert 'LOCAL_FRAME' in {r['code'] for r in seen.live['legs'][0]['reasons']}
    assert seen.live['inputs'][0]['topics']['fix'] == words.split(' on ')[1].split(',')[0]
    assert 'no NavSatFix' not in check_replay(seen.live, seen.journal)    # topics are known


def test_without_tf2_msgs_the_error_names_the_package_to_install():
    if importlib.util.find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed')
    with pytest.raises(BadConfig, match="'tf2_msgs/msg/TFMessage' cannot be imported here: "
                       'install its package'):
        message_class(TF)


def test_one_topic_cannot_be_odometer_and_reference(start):
    node = start({}, '-r', 'fix:=/odom', '-r', 'odometer:=/odom')
    assert node.wait() != 0
    assert ('topic /odom is used as odometer and as fix: an odometer cannot be calibrated '
            'against itself; remap one of them to another topic') in node.text
    assert 'Traceback' not in node.text


def test_an_odometry_topic_is_the_reference_if_fix_is_remapped_to_it(start, connect):
    from nav_msgs.msg import Odometry
    node = start({}, '-r', 'fix:=/lidar/odometry')
    connect().node.create_publisher(Odometry, '/lidar/odometry', 1)
    wait_for(lambda: 'fix: nav_msgs/msg/Odometry on /lidar/odometry' in node.text,
             'a subscription')


@pytest.fixture(scope='module', params=[True, False], ids=['imu', 'no imu'])
def marked(request, tmp_path_factory):
    """Drive a square, with a mark at each point; keep its messages."""
    drive = simulate(SimOptions(scenario='square', odometer='angle', imu_rate=50.0,
                                imu=request.param))
    wheels = dict(zip(('left', 'right'), drive.wheels, strict=True))
    imu = {} if request.param else {'imu': None}
    driven = messages_of(drive, odometer=encode.joints('odometer', wheels), fix=None, **imu)
    settings = {
        'odometer.left': 'left', 'odometer.right': 'right', 'leg.preroll': 20.0,
        'verdict.max_scale_sigma': 0.005, 'output.directory': tmp_path_factory.mktemp('marked'),
        'odometer.nominal_scale': drive.options.nominal_scale,
        'reference.points': f'[{", ".join(f"{x}.0" for x in POINTS)}]'}
    at, answers = 3.0, []
    with playing_to(driven, settings, 20.0) as leg:
        client = leg.client

        def play_to(time):
            nonlocal at
            leg.play(at, time)
            at = time
            wait_for(lambda: client.status.get('duration_s') and client.status, 'a status')
        leg.play(0.0, at)
        client.until(state='idle')
        early = client.call('mark')
        client.start()
        hints = []
        for time in TIMES:
            play_to(time + 1.3)
            answers.append(client.call('mark'))
            hints.append(client.until(state='recording')['hint'] if len(answers) < 3 else '')
            if len(answers) == 1:
                play_to(14.0)
                turning = client.call('mark')
        return SimpleNamespace(drive=drive, early=early, turning=turning, answers=answers,
                               hints=hints, **vars(leg.stopped(at, 3.0)))


def test_marks_are_refused_in_motion_answered_and_requested_by_the_hint(marked):
    assert not marked.early.success
    assert 'call ~/start_leg first, then ~/mark on each point' in marked.early.message
    assert not marked.turning.success
    assert 'stand on the point and call again' in marked.turning.message
    assert all(answer.success for answer in marked.answers)
    answer_texts = [answer.message for answer in marked.answers]
    assert answer_texts[0] == 'mark 1 of leg 1: point 1, x 0 m, y 0 m'
    assert answer_texts[7] == 'mark 8 of leg 1: point 8, x 0 m, y -4 m'
    assert len(marked.status['marks'].split(',')) == len(TIMES)
    assert 'call ~/mark at rest on each point, ' in marked.hints[0]
    assert 'call ~/mark' not in marked.hints[1]


def test_marks_determine_both_wheels_and_the_track_width(marked):
    assert marked.stop.success, marked.stop.message
    options = marked.drive.options
    left, right = marked.drive.truth.wheel_scales
    for name, true in (('scale_factor_left', left), ('scale_factor_right', right),
                       ('track_width', options.track_width)):
        found = marked.live['result'][name]
        assert within(found, true, 3), name
        assert found['sigma'] < (3e-3 if options.imu else 4e-3) * true, name
    codes = {r['code'] for r in marked.live['legs'][0]['reasons']}
    assert ('LOCAL_FRAME' in codes) is options.imu


def test_a_journal_with_marks_replays_identically_and_options_take_precedence(marked):
    check_replay(marked.live, marked.journal)
    with pytest.raises(BadUsage, match='--mark 14: the odometer has no data there'):
        calibrate_bag(marked.journal, config={'reference.marks': [14.0]})
    with pytest.raises(BadUsage, match='a mark of point [2-9], reference.points has 1: use'):
        calibrate_bag(marked.journal, config={'reference.points': [0.0, 0.0]})


def test_without_points_a_mark_is_refused(start, connect):
    start()
    client = connect()
    client.until(state='waiting')
    answer = client.call('mark')
    assert not answer.success
    assert 'reference.points is empty' in answer.message
