# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Overload, many parameter requests, hostile messages: the node continues."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from types import SimpleNamespace

from bench import wait_for
from kills import drive, NUMBERS, replayed, same_result, stamps_of
from player import ends_of, messages_of, playing_to, straight
import pytest
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from wire import Wire

pytestmark = pytest.mark.slow
SPEED = 15.0
FEW = 100      # messages that the queue of the odometer holds
REQUESTS = 20
CLEAN, SOME, HALF = 2, 3, 5     # seeds, for the share of hostile messages


@contextlib.contextmanager
def is_busy():
    """Keep each core busy."""
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
    """Drive a leg with a loop on each core; during the leg the node is stopped for 0.7 s."""
    settings = {'output.directory': tmp_path_factory.mktemp('out'),
                'qos_overrides./odometer.subscription.depth': FEW}
    with playing_to(messages_of(straight()), settings, SPEED) as leg, is_busy() as loops:
        leg.play(45, 60)
        leg.client.start()
        leg.play(60, 80)
        leg.node.process.send_signal(signal.SIGSTOP)
        try:
            leg.play(80, 90)
        finally:
            leg.node.process.send_signal(signal.SIGCONT)
        leg.play(90, 115)
        for loop in loops:
            loop.kill()
        client = leg.client
        loss_status = wait_for(lambda: int(client.status['messages_lost']) and client.status,
                               'a count')
        seen = leg.stopped(115)
        wait_for(lambda: 'messages of /odometer lost. Likely' in leg.node.text, 'a word')
        return SimpleNamespace(sent=leg.sent, loss_status=loss_status, **vars(seen))


def test_messages_lost_by_the_queue_are_counted_and_reported(leg):
    start_ns, stop_ns = ends_of(leg.status)
    kept = sum(start_ns < ns <= stop_ns for ns in stamps_of(leg.journal, '/odometer'))
    sent = sum(start_ns < one.stamp_ns <= stop_ns for one in leg.sent if one.slot == 'odometer')
    assert kept < 0.95 * sent
    lost, = re.findall(r'(\d+) messages of /odometer lost', leg.status['message'])
    assert int(lost) == sent - kept
    # while the node is stopped, the socket also loses messages of other topics
    assert int(leg.status['messages_lost']) >= int(lost)
    assert 'messages of /odometer lost' in leg.loss_status['message']


def test_the_result_after_an_overload_equals_that_of_replay(leg):
    offline = replayed(leg.journal, *NUMBERS)[1]
    same_result(leg.live, offline)
    assert [(one['start_ns'], one['stop_ns']) for one in leg.live['legs']] == [
        (one['start_ns'], one['stop_ns']) for one in offline['legs']]


def flood(client):
    """Send many requests to set all parameters to odd values; return the futures."""
    call = client.send(ListParameters, 'list_parameters', ListParameters.Request())
    wait_for(call.done, 'the names of the parameters')
    names, futures = call.result().result.names, []
    for k in range(REQUESTS):
        new_parameters = [Parameter(name, value=value).to_parameter_msg()
                          for name in names for value in (k, 'x' * 50, float('nan'), [True] * 100)]
        futures += [
            client.send(SetParameters, 'set_parameters',
                        SetParameters.Request(parameters=new_parameters)),
            client.send(SetParametersAtomically, 'set_parameters_atomically',
                        SetParametersAtomically.Request(parameters=new_parameters))]
    return futures


def test_a_leg_survives_many_parameter_requests_and_a_restart_of_the_sender(play_to):
    leg = play_to(messages_of(straight()), speed=SPEED)
    leg.record(45, 60)
    with leg.playing(60, 95):
        futures = flood(leg.client)
        wait_for(lambda: all(one.done() for one in futures), 'the answers')
        wait_for(lambda: float(leg.client.status['duration_s']) > 34.0, 'the rest of the drive')
    for one in futures:
        answer = one.result()
        results = answer.results if hasattr(answer, 'results') else [answer.result]
        assert not any(result.successful for result in results)
        assert all(result.reason for result in results)
    assert len(leg.node.lines) < 20
    for publisher in leg.player.publishers.values():
        leg.client.node.destroy_publisher(publisher)
    del leg.player      # a new one is made
    leg.play(95, 115)
    assert 'scale factor 1.0' in leg.ended(115).message
    assert leg.node.process.poll() is None


@pytest.fixture(scope='module')
def wire(tmp_path_factory):
    one = Wire(drive(), tmp_path_factory.mktemp('wire'), 15.0)
    yield one
    one.close()


def test_a_drive_without_a_hostile_message_is_accepted(wire):
    """Otherwise the fuzz test has no meaning."""
    seen = wire.round(CLEAN)
    assert (seen.hostile, seen.wrong) == (0, [])
    assert seen.accepted


@pytest.mark.parametrize('seed', [SOME, HALF])
def test_the_node_survives_hostile_messages_and_accepts_no_wrong_result(wire, seed):
    seen = wire.round(seed)
    assert seen.hostile
    assert seen.calls >= 2
    assert seen.wrong == []
