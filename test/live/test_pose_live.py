# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses on the topic fix, over DDS: a leg by services; its journal replays to the same bits."""


from bench import given, wait_for
from kills import replayed, same_result
from player import part, playing_to, sent_of, stopped
import pytest

from odocal_ros.bagio import encode
from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 30.0
NAMES = {'fix': '/slam/pose'}


@pytest.fixture(scope='module')
def drive():
    """Simulate two minutes of town."""
    return simulate(SimOptions(scenario='town', duration=200.0, imu_rate=50.0, odometer_rate=25.0,
                               odometer='speed', fix_noise='rtk', reference='pose', seed=4))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive one leg; keep what the node said and wrote."""
    topics = {'imu': encode.imu('imu/data', drive.imu),
              'odometer': encode.twist('odometer', drive.odometer),
              'fix': encode.pose('pose', drive.fix, drive.positions())}
    sent = sorted((one for slot, topic in topics.items() for one in sent_of(slot, topic)),
                  key=lambda one: one.stamp_ns)
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    settings = {'output.directory': tmp_path_factory.mktemp('posed'), 'leg.preroll': 20.0}
    types = {slot: topic.msgtype for slot, topic in topics.items()}
    with playing_to(types, *given(settings), '-r', 'fix:=/slam/pose', names=NAMES) as (
            node, client, player):
        player.play(part(sent, start_s - 10, start_s), SPEED)
        client.start()
        player.play(part(sent, start_s, start_s + 150), SPEED)
        seen = stopped(client, player, part(sent, start_s + 150, start_s + 153), SPEED)
        seen.node = node
        yield seen


def test_the_node_subscribes_with_the_type_that_is_published(session):
    assert 'fix: geometry_msgs/msg/PoseStamped on /slam/pose, best effort' in session.node.text


def test_a_leg_with_poses_finds_the_truth(session, drive):
    assert session.stop.success, session.stop.message
    scale = session.live['result']['scale_factor']
    assert abs(scale['value'] - drive.truth.scale) < 4 * scale['sigma'] < 0.004
    assert 'LOCAL_FRAME' in {r['code'] for r in session.live['legs'][0]['reasons']}


def test_its_journal_replays_to_the_last_bit(session):
    code, offline, said = replayed(session.journal)
    assert code == 0, said
    assert 'no NavSatFix' not in said       # the journal names its topics
    same_result(session.live, offline, 'config')
    for here, there in zip(session.live['legs'], offline['legs'], strict=True):
        assert here | {'bag': session.journal.name} == there
    assert offline['inputs'][0]['topics']['fix'] == '/slam/pose'


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
