# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node in simulated time: what it hears late was sent in time."""

import signal
import time

from bench import wait_for
from player import messages_of, part, Player
import pytest
from rosgraph_msgs.msg import Clock

from odocal_ros.sim.scenarios import SimOptions, simulate


@pytest.fixture(scope='module')
def sent():
    drive = simulate(SimOptions(duration=180.0, imu_rate=100.0, odometer_rate=10.0,
                                odometer='speed'))
    types, messages = messages_of(drive)
    return types, part(messages, 40, 90)


def test_messages_that_queue_are_no_clocks_that_differ(start, connect, sent):
    """The node stands still for a moment, as on a busy machine; simulation does not wait."""
    node = start('-p', 'use_sim_time:=true', '-p', 'publish.rate:=20.0')
    client = connect()
    clock = client.node.create_publisher(Clock, '/clock', 10)
    player = Player(client.node, sent[0])
    wait_for(lambda: player.matched() and clock.get_subscription_count(), 'subscriptions')

    def play(first_s, last_s, pause_s):
        for one in part(sent[1], first_s, last_s):
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(one.stamp_ns, 10**9)
            clock.publish(message)
            player.publishers[one.slot].publish(one.raw)
            time.sleep(pause_s)

    play(0, 10, 0.001)
    client.until(state='idle')
    for first_s in (10, 20, 30):
        node.process.send_signal(signal.SIGSTOP)
        play(first_s, first_s + 8, 0.0)
        node.process.send_signal(signal.SIGCONT)
        play(first_s + 8, first_s + 10, 0.001)
    client.until(state='idle')
    assert not [s['hint'] for s in client.statuses if 'CLOCKS_DIFFER' in s['hint']]
    assert client.call('start_leg').success
