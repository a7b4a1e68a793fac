# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two IMUs alternate on one topic, over DDS: both nodes say so, and the leg is rejected."""

from contextlib import ExitStack
from types import SimpleNamespace

from bench import NodeProcess, wait_for
from player import ended, messages_of, part, playing_to, Sent, straight
import pytest

from odocal_ros.messages.cdr import FRAME_AT

SPEED = 15.0
FIRST_S, MARK_S, STOP_S, END_S = 45, 60, 115, 117     # of the drive: played, and the leg
WORDS = "carries several IMUs (frame_id 'imu_link' and 'rmu_link'): set imu.frame_id"


def alternating(sent):
    """Return messages, every second one of the IMU with another frame_id."""
    imu = [one for one in sent if one.slot == 'imu']
    other = {id(one) for one in imu[1::2]}
    return [Sent(one.stamp_ns, one.slot, one.raw[:FRAME_AT] + b'r' + one.raw[FRAME_AT + 1:])
            if id(one) in other else one for one in sent]


@pytest.fixture(scope='module')
def seen(tmp_path_factory):
    """Drive one leg; keep what the nodes said."""
    types, sent = messages_of(straight(imu_grade='industrial'))
    sent = alternating(sent)
    file = tmp_path_factory.mktemp('given') / 'calibration.yaml'
    file.write_text('/**: {ros__parameters: {result: {scale_factor: 1.0, scale_factor_sigma: '
                    '0.001, valid: true, stamp: "2026-01-01"}}}')
    odometry = NodeProcess('--params-file', str(file), module='odometry')
    found = SimpleNamespace(odometry=odometry)
    folder = tmp_path_factory.mktemp('out')
    with ExitStack() as ends:
        ends.callback(odometry.end)
        found.node, client, player = ends.enter_context(
            playing_to(types, '-p', f'output.directory:={folder}'))
        wait_for(lambda: player.publishers['imu'].get_subscription_count() == 2, 'both nodes')
        player.play(part(sent, FIRST_S, MARK_S), SPEED)
        client.start()
        player.play(part(sent, MARK_S, STOP_S), SPEED)
        found.recording = client.status
        found.stop = ended(client, player, part(sent, STOP_S, END_S), SPEED)
        found.status = client.until(state='rejected')
        wait_for(lambda: 'several IMUs' in odometry.text, f'a word: {odometry.text}')
    return found


def test_both_nodes_say_so_and_the_leg_is_rejected_with_the_setting_that_chooses(seen):
    assert WORDS in seen.recording['message']
    assert seen.recording['level'] == b'\1'
    assert seen.node.text.count(WORDS) == 1
    assert not seen.stop.success
    assert 'SEVERAL_IMUS' in seen.stop.message
    assert "imu.frame_id: 'imu_link'" in seen.stop.message
    assert 'SEVERAL_IMUS' in seen.status['reasons']
    assert seen.odometry.text.count(WORDS) == 1
