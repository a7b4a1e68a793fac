# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""TF as a reference over DDS, with a static transform; its journal replays to the same bits."""

import importlib.util
from types import SimpleNamespace

from bench import given, wait_for
from kills import check_replay
import numpy as np
from player import messages_of, part, playing_to, Sent, stopped
import pytest
import ros_messages as make

from odocal_ros.errors import BadConfig
from odocal_ros.live.messages import message_class
from odocal_ros.sim.scenarios import SimOptions, simulate

TF = 'tf2_msgs/msg/TFMessage'
SPEED = 30.0
HALF = 0.5 ** 0.5


def transforms(t_ns, place, child, frame):
    return [Sent(int(t), 'fix', make.cdr(make.kind(TF)(transforms=[
        make.transform(int(t), p, child, frame)]))) for t, p in zip(t_ns, place, strict=True)]


def fixed(child, frame):
    """Return a message of /tf_static: a turn of a quarter, which leaves the positions."""
    one = make.transform(0, (0.0, 0.0, 0.0), child, frame)
    one.transform.rotation.z = one.transform.rotation.w = HALF
    return make.cdr(make.kind(TF)(transforms=[one]))


@pytest.fixture(scope='module')
def drive():
    return simulate(SimOptions(scenario='town', duration=200.0, imu_rate=50.0, odometer_rate=25.0,
                               odometer='speed', fix_noise='rtk', reference='pose', seed=4))


def sent_by(drive):
    """Return slot -> type, and the messages: odom creeps away at 0.1 m/s, SLAM corrects it."""
    types, sent = messages_of(drive, fix=None)
    t_fix, t = drive.fix.stamp_ns, drive.odometer.stamp_ns

    def creep(at_ns):
        return np.outer((at_ns - t[0]) * 1e-10, [1.0, 0.0, 0.0])
    sent += transforms(t_fix, drive.positions() - creep(t_fix), 'odom', 'map')
    sent += transforms(t, creep(t), 'base_link', 'odom')
    return types | {'fix': TF}, sorted(sent, key=lambda one: one.stamp_ns)


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive one leg; keep what the node said and wrote."""
    messages = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed')
    from rclpy.qos import DurabilityPolicy, QoSProfile
    types, sent = sent_by(drive)
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    settings = {'output.directory': tmp_path_factory.mktemp('tf'), 'leg.preroll': 20.0,
                'reference.frames': '[map, prism]'}
    with playing_to(types, *given(settings), names={'fix': '/tf'}) as (node, client, player):
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = client.node.create_publisher(messages.TFMessage, '/tf_static', latched)
        publisher.publish(fixed('prism', 'base_link'))
        wait_for(publisher.get_subscription_count, 'a subscription to /tf_static')
        player.play(part(sent, start_s - 60, start_s), SPEED)
        client.start()
        player.play(part(sent, start_s, start_s + 150), SPEED)
        seen = stopped(client, player, part(sent, start_s + 150, start_s + 153), SPEED)
        yield SimpleNamespace(node=node, **vars(seen))


def test_a_leg_by_tf_finds_the_truth(session, drive):
    assert 'fix: tf2_msgs/msg/TFMessage on /tf, best effort' in session.node.text
    assert session.stop.success, session.stop.message
    scale = session.live['result']['scale_factor']
    assert abs(scale['value'] - drive.truth.scale) < 4 * scale['sigma'] < 0.004


def test_its_journal_replays_to_the_last_bit(session):
    check_replay(session.live, session.journal)


def test_without_tf2_msgs_the_node_says_what_to_install():
    if importlib.util.find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed')
    with pytest.raises(BadConfig, match="'tf2_msgs/msg/TFMessage' cannot be imported here: "
                       'install its package'):
        message_class(TF)
