# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Three live legs with a headerless counter on a busy machine: lateness is no slip, slip is."""

from dataclasses import replace
import json
import subprocess
import sys
import time

from bench import Client, NodeProcess, wait_for
import numpy as np
from player import by_now, Player, Sent, sent_of
import pytest

from odocal_ros.bagio import encode
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
FIRST_S, START_S, SLIP_S, LAST_S = 12.0, 18.0, 36.0, 54.0     # of the drive, in real time
SLIP_M, SLIP_LASTS_S = 0.5, 0.5
HELD_EVERY_S, HELD_S = 7.0, 0.12
TYPES = {'imu': 'sensor_msgs/msg/Imu', 'fix': 'sensor_msgs/msg/NavSatFix'} | dict.fromkeys(
    ('free', 'held', 'slip'), 'std_msgs/msg/Int64')
LEGS = {'free': (False, False), 'held': (True, False), 'slip': (True, True)}


# a core at work for 0.1 s of each 0.4 s: threads wait for it, and are woken late
BUSY = ('import os, time; os.nice(5)\n'
        'while True:\n'
        '    until = time.monotonic() + 0.1\n'
        '    while time.monotonic() < until: pass\n'
        '    time.sleep(0.3)\n')


def messages(drive, begin_ns):
    """Return the messages of IMU, fixes and a counter for each leg, by when they go out."""
    def moved(samples):
        stamps = samples.stamp_ns + begin_ns - drive.imu.stamp_ns[0]
        return replace(samples, stamp_ns=stamps, received_ns=stamps)

    topics = {'imu': encode.imu('imu', moved(drive.imu)),
              'fix': encode.fix('fix', moved(drive.fix))}
    t = (drive.odometer.stamp_ns - drive.imu.stamp_ns[0]) * 1e-9
    sent = [one for slot, topic in topics.items() for one in sent_of(slot, topic)]
    for name, (held, slips) in LEGS.items():
        more = SLIP_M / drive.truth.scale * np.clip((t - SLIP_S) / SLIP_LASTS_S, 0.0, 1.0) * slips
        counts = replace(moved(drive.odometer),
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


def test_lateness_is_no_slip_and_slip_is_found(tmp_path):
    drive = simulate(SimOptions(
        scenario='town', duration=135.0, imu_rate=50.0, odometer_rate=50.0, fix_noise='rtk',
        imu_grade='industrial', seed=8))
    nodes = [NodeProcess('-r', f'__ns:=/{name}', '-r', 'imu/data:=/imu', '-r', 'fix:=/fix', '-r',
                         f'odometer:=/{name}/ticks', '-p', 'imu.grade:=industrial',
                         '-p', f'vehicle:={name}', '-p', 'output.formats:=[params]',
                         env={'ROS_HOME': str(tmp_path)})
             for name in LEGS]
    clients = {name: Client(f'/{name}/calibrator') for name in LEGS}
    load = None
    try:
        player = Player(clients['free'].node, TYPES, {'imu': '/imu', 'fix': '/fix'} | {
            name: f'/{name}/ticks' for name in LEGS})
        wait_for(player.matched, 'subscriptions of the nodes')
        first_ns, sent = by_now(lambda ns: messages(drive, ns - round(FIRST_S * 1e9)))
        begin_ns = first_ns - round(FIRST_S * 1e9)
        # a little nicer than the test: else it is the player that cannot keep up
        load = subprocess.Popen([sys.executable, '-c', BUSY])
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
    finally:
        if load is not None:
            load.kill()
            load.wait()
        for client in clients.values():
            client.close()
        for node in nodes:
            node.end()
    for name in ('free', 'held'):
        assert answers[name].message.startswith('accepted'), answers[name].message
        assert 'WHEEL_SLIP' not in reasons[name]
    assert 'ODOMETER_LATE' in reasons['held']
    for name in LEGS:     # each with a folder and a journal of its own
        own = tmp_path / 'odocal' / name / 'calibrator'
        assert len(list((own / 'journal').iterdir())) == 1
        told = json.loads((own / 'latest' / 'calibration.json').read_text())
        assert (told['vehicle'], told['inputs'][0]['node']) == (name, f'/{name}/calibrator')
    text = answers['slip'].message
    assert 'WHEEL_SLIP' in text
    size, at = text.split('travel of the vehicle: ')[1].split(' s (')[0].split(' m at t = ')
    assert float(size) == pytest.approx(SLIP_M, abs=0.15)
    assert float(at) == pytest.approx(SLIP_S - START_S, abs=1.5)
