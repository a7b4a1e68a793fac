# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Overload, late messages, many parameter requests, hostile messages: the node continues."""

import contextlib
from dataclasses import replace
import json
import os
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

from bench import Client, given, NodeProcess, wait_for
from kills import drive, NUMBERS, replayed, same_result, stamps_of
import numpy as np
from player import (
    by_now,
    ends_of,
    messages_of,
    moved,
    Player,
    playing_to,
    Sent,
    sent_of,
    straight,
)
import pytest
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from wire import Wire

from odocal_ros.bagio import encode
from odocal_ros.sim.scenarios import SimOptions, simulate

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


# three live legs with a headerless counter on a busy machine
FIRST_S, START_S, SLIP_S, LAST_S = 12.0, 18.0, 36.0, 54.0     # of the drive, in real time
SLIP_M, SLIP_LASTS_S = 0.5, 0.5
HELD_EVERY_S, HELD_S = 7.0, 0.12
TYPES = {'imu': 'sensor_msgs/msg/Imu', 'fix': 'sensor_msgs/msg/NavSatFix'} | dict.fromkeys(
    ('free', 'held', 'slip'), 'std_msgs/msg/Int64')
LEGS = {'free': (False, False), 'held': (True, False), 'slip': (True, True)}
# a core busy for 0.1 s of each 0.4 s: waiting threads wake up late
BUSY = ('import os, time; os.nice(5)\n'
        'while True:\n'
        '    until = time.monotonic() + 0.1\n'
        '    while time.monotonic() < until: pass\n'
        '    time.sleep(0.3)\n')


def messages(drive, begin_ns):
    """Return the messages of IMU, fixes and a counter for each leg, in order of sending."""
    by_ns = begin_ns - drive.imu.stamp_ns[0]
    topics = {'imu': encode.imu('imu', moved(drive.imu, by_ns)),
              'fix': encode.fix('fix', moved(drive.fix, by_ns))}
    t = (drive.odometer.stamp_ns - drive.imu.stamp_ns[0]) * 1e-9
    sent = [one for slot, topic in topics.items() for one in sent_of(slot, topic)]
    for name, (held, slips) in LEGS.items():
        more = SLIP_M / drive.truth.scale * np.clip((t - SLIP_S) / SLIP_LASTS_S, 0.0, 1.0) * slips
        counts = replace(moved(drive.odometer, by_ns),
                         value=drive.odometer.value + np.round(more).astype(np.int64))
        late = np.where(held & (t % HELD_EVERY_S < HELD_S), HELD_S - t % HELD_EVERY_S, 0.0)
        sent += [Sent(one.stamp_ns + round(s * 1e9), name, one.raw)
                 for one, s in zip(sent_of(name, encode.counter(name, counts)), late, strict=True)]
    return sorted(sent, key=lambda one: one.stamp_ns)


def play(player, sent, begin_ns, first_s, last_s):
    for one in sent:
        if first_s <= (one.stamp_ns - begin_ns) * 1e-9 < last_s:
            time.sleep(max(0.0, (one.stamp_ns - time.time_ns()) * 1e-9))
            player.publishers[one.slot].publish(one.raw)


def test_late_counts_are_not_slip_and_slip_is_found(tmp_path):
    drive = simulate(SimOptions(
        scenario='town', duration=135.0, imu_rate=50.0, odometer_rate=50.0, fix_noise='rtk',
        imu_grade='industrial', seed=8))
    clients = {}
    with contextlib.ExitStack() as ends:
        for name in LEGS:
            settings = {'imu.grade': 'industrial', 'vehicle': name, 'output.formats': '[params]'}
            node = NodeProcess('-r', f'__ns:=/{name}', '-r', 'imu/data:=/imu', '-r', 'fix:=/fix',
                               '-r', f'odometer:=/{name}/ticks', *given(settings),
                               env={'ROS_HOME': str(tmp_path)})
            clients[name] = Client(f'/{name}/calibrator')
            ends.callback(node.end)
            ends.callback(clients[name].close)
        player = Player.connected(clients['free'], TYPES, {'imu': '/imu', 'fix': '/fix'} | {
            name: f'/{name}/ticks' for name in LEGS})
        first_ns, sent = by_now(lambda ns: messages(drive, ns - round(FIRST_S * 1e9)))
        begin_ns = first_ns - round(FIRST_S * 1e9)
        # lower priority than the test: otherwise the player is too slow
        load = subprocess.Popen([sys.executable, '-c', BUSY])
        ends.callback(load.wait)
        ends.callback(load.kill)
        play(player, sent, begin_ns, FIRST_S, START_S)
        starting = [client.ask('start_leg') for client in clients.values()]
        play(player, sent, begin_ns, START_S, LAST_S)
        assert [one.result().message for one in starting if not one.result().success] == []
        load.kill()
        stopping = {name: client.ask('stop_leg') for name, client in clients.items()}
        answers = {name: clients[name].result(one) for name, one in stopping.items()}
        for client in clients.values():
            wait_for(lambda client=client: client.status['saved'], 'the saved folder')
        reasons = {name: one.until(state='calibrated')['reasons'] for name, one in clients.items()}
    for name in ('free', 'held'):
        assert answers[name].message.startswith('accepted'), answers[name].message
        assert 'WHEEL_SLIP' not in reasons[name]
    assert 'ODOMETER_LATE' in reasons['held']
    for name in LEGS:     # each has its own folder and journal
        folder = tmp_path / 'odocal' / name / 'calibrator'
        assert len(list((folder / 'journal').iterdir())) == 1
        content = json.loads((folder / 'latest' / 'calibration.json').read_text())
        assert (content['vehicle'], content['inputs'][0]['node']) == (name, f'/{name}/calibrator')
    text = answers['slip'].message
    assert 'WHEEL_SLIP' in text
    size, at = text.split('travel of the vehicle: ')[1].split(' s for ')[0].split(' m at t = ')
    assert float(size) == pytest.approx(SLIP_M, abs=0.15)
    assert float(at) == pytest.approx(SLIP_S - START_S, abs=1.5)
