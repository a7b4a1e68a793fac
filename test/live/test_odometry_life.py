# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node odometry goes on after an error of its own, in real and in simulated time."""

import importlib.util

from bench import Client, NodeProcess, wait_for
import numpy as np
from player import messages_of, part, Player, with_clock
import pytest
from rclpy.qos import QoSProfile

from odocal_ros.apply.pose import Pose
from odocal_ros.live.odometry import transform_of
from odocal_ros.settings.node_configs import OdomFrames
from odocal_ros.sim.scenarios import SimOptions, simulate

RESULT = ('-p', 'result.valid:=true', '-p', 'result.scale_factor:=1.0', '-p',
          'result.scale_factor_sigma:=0.001')
# the first path that has poses ends in an error
FAILS = """
from odocal_ros.apply.reckoning import Reckoning
_poses, _failed = Reckoning.poses, []
def poses(self, *args):
    found = _poses(self, *args)
    if found and not _failed:
        _failed.append(None)
        1 / 0
    return found
Reckoning.poses = poses
"""


def test_tf_without_its_message_says_what_to_install():
    if importlib.util.find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed')
    node = NodeProcess(*RESULT, '-p', 'publish_tf:=true', module='odometry')
    assert node.wait() == 1
    assert node.lines[-1:] == [
        'odometry: publish_tf needs the package tf2_msgs, which is not installed: install '
        'ros-jazzy-tf2-msgs, or set publish_tf to false']


def test_the_transform_is_the_pose():
    pose = Pose(1_234_567_890_123, np.array([1.0, -2.0, 0.5, 0.1, 0.2, 0.3, 0.9, *[0.0] * 78]))
    out = transform_of(pose, OdomFrames(base='car', odom='map'))
    assert (out.header.stamp.sec, out.header.stamp.nanosec) == (1234, 567_890_123)
    assert (out.header.frame_id, out.child_frame_id) == ('map', 'car')
    move, turn = out.transform.translation, out.transform.rotation
    assert (move.x, move.y, move.z) == (1.0, -2.0, 0.5)
    assert (turn.x, turn.y, turn.z, turn.w) == (0.1, 0.2, 0.3, 0.9)


@pytest.fixture(scope='module')
def sent():
    types, messages = messages_of(simulate(SimOptions(
        scenario='out_and_back', duration=240.0, imu_rate=50.0, odometer_rate=20.0,
        odometer='speed')))
    return {slot: types[slot] for slot in ('imu', 'odometer')}, [
        one for one in part(messages, 0, 40) if one.slot != 'fix']


@pytest.mark.parametrize('simulated', [False, True])
def test_it_goes_on_after_an_error_of_its_own(sent, simulated):
    from nav_msgs.msg import Odometry
    from rcl_interfaces.srv import GetParameters
    node = NodeProcess(*RESULT, '-p', f'use_sim_time:={str(simulated).lower()}', before=FAILS,
                       module='odometry')
    client, seen = Client('odometry'), []
    try:
        client.node.create_subscription(Odometry, 'odometry', seen.append, QoSProfile(depth=5000))
        player = Player.connected(client, sent[0])
        play = with_clock(client, player) if simulated else player.play
        asked = client.node.create_client(GetParameters, 'odometry/get_parameters').call_async(
            GetParameters.Request(names=['publish.rate']))
        play(sent[1], *(() if simulated else (7.0,)))
        wait_for(lambda: seen and seen[-1].header.stamp.sec > sent[1][-1].stamp_ns // 10**9 - 2,
                 f'the last pose; the node says {node.text}')
        assert asked.result().values[0].double_value == 20.0
    finally:
        code = node.end()
        client.close()
    assert code == 0
    assert 'restarts, from the origin: internal error, please report it: ZeroDivisionError' in (
        node.text)
    assert len(seen) > 500
