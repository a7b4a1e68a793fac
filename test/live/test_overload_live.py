# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An overloaded machine, a flood of parameters, hostile messages: counted, the node goes on."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from types import SimpleNamespace

from bench import given, wait_for
from kills import drive, NUMBERS, replayed, same_result
from player import ended, messages_of, part, Player, playing_to, recording, stopped, straight
import pytest
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from wire import Wire

from odocal_ros.bagio.read import open_bag

pytestmark = pytest.mark.slow
SPEED = 15.0
BEFORE_S, MARK_S, HELD_S, GOES_ON_S, STOP_S, END_S = 45, 60, 80, 90, 115, 117    # of the drive
FEW = 100      # messages that the queue of the odometer holds
REQUESTS = 20
CLEAN, SOME, HALF = 2, 3, 5     # seeds: how much of a round is hostile


@contextlib.contextmanager
def busy():
    """Keep each core at work."""
    loops = [subprocess.Popen([sys.executable, '-c', 'while True: pass'])
             for _ in range(os.cpu_count())]
    try:
        yield loops
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@pytest.fixture(scope='module')
def leg(tmp_path_factory):
    """Drive a leg with a loop on each core; in its midst the node is stopped for 0.7 s."""
    types, sent = messages_of(straight())
    settings = {'output.directory': tmp_path_factory.mktemp('out'),
                'qos_overrides./odometer.subscription.depth': FEW}
    with playing_to(types, *given(settings)) as (node, client, player), busy() as loops:
        player.play(part(sent, BEFORE_S, MARK_S), SPEED)
        client.start()
        player.play(part(sent, MARK_S, HELD_S), SPEED)
        node.process.send_signal(signal.SIGSTOP)
        try:
            player.play(part(sent, HELD_S, GOES_ON_S), SPEED)
        finally:
            node.process.send_signal(signal.SIGCONT)
        player.play(part(sent, GOES_ON_S, STOP_S), SPEED)
        for loop in loops:
            loop.kill()
        said = wait_for(lambda: int(client.status['messages_lost']) and client.status, 'a count')
        seen = stopped(client, player, part(sent, STOP_S, END_S), SPEED)
        wait_for(lambda: 'messages of /odometer lost. Likely' in node.text, 'a word')
        return SimpleNamespace(sent=sent, said=said, **vars(seen))


def test_what_the_queue_lost_is_counted_and_said(leg):
    start_ns, stop_ns = (int(leg.status[f'leg_{mark}_ns']) for mark in ('start', 'stop'))
    with open_bag(leg.journal) as bag:
        kept = sum(start_ns < m.header.stamp.sec * 10**9 + m.header.stamp.nanosec <= stop_ns
                   for _, m in bag.messages('/odometer'))
    sent = sum(start_ns < one.stamp_ns <= stop_ns for one in leg.sent if one.slot == 'odometer')
    assert kept < 0.95 * sent
    lost, = re.findall(r'(\d+) messages of /odometer lost', leg.status['message'])
    assert int(lost) == sent - kept
    # while the node is stopped the socket overflows as well: of other topics
    assert int(leg.status['messages_lost']) >= int(lost)
    assert 'messages of /odometer lost' in leg.said['message']


def test_the_result_is_that_of_a_replay(leg):
    offline = replayed(leg.journal, *NUMBERS)[1]
    same_result(leg.live, offline)
    assert [(one['start_ns'], one['stop_ns']) for one in leg.live['legs']] == [
        (one['start_ns'], one['stop_ns']) for one in offline['legs']]


def flood(client):
    """Ask to set all parameters to odd values, again and again; return the futures."""
    asked = client.send(ListParameters, 'list_parameters', ListParameters.Request())
    wait_for(asked.done, 'the names of the parameters')
    names, futures = asked.result().result.names, []
    for k in range(REQUESTS):
        wanted = [Parameter(name, value=value).to_parameter_msg()
                  for name in names for value in (k, 'x' * 50, float('nan'), [True] * 100)]
        futures += [
            client.send(SetParameters, 'set_parameters', SetParameters.Request(parameters=wanted)),
            client.send(SetParametersAtomically, 'set_parameters_atomically',
                        SetParametersAtomically.Request(parameters=wanted))]
    return futures


def test_a_leg_survives_a_flood_of_parameters_and_a_restart_of_the_sender(start, connect):
    types, sent = messages_of(straight())
    node, client = start(), connect()
    player = recording(client, (types, sent), 45, 60, SPEED)
    with player.playing(part(sent, 60, 95), SPEED):
        futures = flood(client)
        wait_for(lambda: all(one.done() for one in futures), 'the answers')
        wait_for(lambda: float(client.status['duration_s']) > 34.0, 'the rest of the drive')
    for one in futures:
        answer = one.result()
        results = answer.results if hasattr(answer, 'results') else [answer.result]
        assert not any(result.successful for result in results)
        assert all(result.reason for result in results)
    assert len(node.lines) < 20
    for publisher in player.publishers.values():
        client.node.destroy_publisher(publisher)
    player = Player.connected(client, types)
    player.play(part(sent, 95, 115), SPEED)
    answer = ended(client, player, part(sent, 115, 117), SPEED)
    assert 'scale factor 1.0' in answer.message
    assert node.process.poll() is None


@pytest.fixture(scope='module')
def wire(tmp_path_factory):
    one = Wire(drive(), tmp_path_factory.mktemp('wire'), 15.0)
    yield one
    one.close()


def test_a_drive_without_a_hostile_message_is_accepted(wire):
    """Else the fuzz shows nothing."""
    seen = wire.round(CLEAN)
    assert (seen.hostile, seen.wrong) == (0, [])
    assert seen.accepted


@pytest.mark.parametrize('seed', [SOME, HALF])
def test_the_node_lives_answers_and_accepts_nothing_false(wire, seed):
    seen = wire.round(seed)
    assert seen.hostile
    assert seen.calls >= 2
    assert seen.wrong == []
