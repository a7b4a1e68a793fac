# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The journal of a real node: replayed to the last bit, killed, undone, without a disk."""

from dataclasses import replace
import json
from pathlib import Path
import resource
import time

from bench import given, wait_for
from kills import check_replay, drive, killed, remains, replayed, same_result, wrong
import numpy as np
from player import (
    by_now,
    messages_of,
    part,
    Player,
    playing_to,
    recording,
    sent_of,
    stopped,
    straight,
)
import pytest

from odocal_ros.bagio import encode
from odocal_ros.bagio.read import open_bag
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
SPEED = 30.0
NAMES = {'imu': '/front/imu', 'fix': '/gps/fix'}


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """Drive three legs through one node: kept, cancelled, undone."""
    simulated = straight(heading=0.7)
    types, sent = messages_of(simulated)
    folder = tmp_path_factory.mktemp('journal')
    settings = {'output.directory': folder, 'alignment.heading_source': 'fixed',
                'alignment.heading': simulated.truth.heading, 'leg.preroll': 20.0}
    with playing_to(types, *given(settings), names=NAMES) as (_, client, player):
        player.play(part(sent, 30, 60), SPEED)
        client.until(state='idle')
        client.call('start_leg')
        player.play(part(sent, 60, 115), SPEED)
        seen = stopped(client, player, part(sent, 115, 117), SPEED)
        seen.kept = seen.journal
        # a leg that is cancelled, and one that is undone after it was joined
        player.play(part(sent, 117, 118), SPEED)
        client.start()
        player.play(part(sent, 118, 122), SPEED)
        client.call('cancel_leg')
        seen.cancelled = Path(wait_for(lambda: client.status['journal'] != str(seen.kept)
                                       and client.status['journal'], 'another journal'))
        player.play(part(sent, 122, 123), SPEED)
        client.start()
        player.play(part(sent, 123, 125), SPEED)
        stopping = client.ask('stop_leg')
        player.play(part(sent, 125, 127), SPEED)
        client.result(stopping)
        seen.undone = Path(wait_for(lambda: client.status['journal'] != str(seen.cancelled)
                                    and client.status['journal'], 'the third journal'))
        wait_for((seen.undone / 'metadata.yaml').exists, 'its end')
        client.call('undo_leg')
        wait_for((seen.undone / f'{seen.undone.name}_1.mcap').exists, 'the mark')
    return seen


def stamps_of(journal, topic):
    with open_bag(journal) as bag:
        return [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
                for _, m in bag.messages(topic)]


def test_a_journal_replays_to_the_last_bit_without_options(session):
    said = check_replay(session.live, session.kept)
    assert session.live['inputs'][0]['topics'] == {
        'imu': '/front/imu', 'odometer': '/odometer', 'fix': '/gps/fix'}
    assert 'is a journal: settings and topics come from' in said


def test_it_is_one_bag_with_the_preroll_and_every_message_once(session):
    assert sorted(p.name for p in session.kept.iterdir()) == [
        f'{session.kept.name}_0.mcap', 'journal.yaml', 'metadata.yaml']
    start_ns, stop_ns = (int(session.status[f'leg_{end}_ns']) for end in ('start', 'stop'))
    stamps = stamps_of(session.kept, '/front/imu')
    assert set(np.diff(stamps)) == {20_000_000}
    assert start_ns - stamps[0] >= 20_000_000_000     # the pre-roll asked for
    assert stamps[-1] > stop_ns


def test_options_win_over_the_settings_of_a_journal(session):
    code, result, _ = replayed(session.kept, '--set', 'leg.min_distance=5000')
    assert code == 1
    assert result['config']['leg.min_distance'] == 5000.0


def test_dropped_legs_are_not_replayed(session):
    for journal in (session.cancelled, session.undone):
        code, result, said = replayed(journal)
        assert (code, result) == (2, None)
        assert 'cancelled or undone' in said
        assert '--leg :' in said
    assert replayed(session.undone, '--leg', ':')[1] is not None
    code, result, said = replayed(session.undone, str(session.kept))
    assert code == 0, said
    assert 'cancelled or undone' in said
    same_result(session.live, result, 'config')


@pytest.mark.parametrize('moment_s', [0.3, 1.3, 2.6])
def test_a_killed_leg_is_replayed_from_its_mark(tmp_path, moment_s):
    left = killed(drive(), moment_s, tmp_path)
    assert left.marks == [(left.start_ns, 0)]
    # a second by design, of what the node had heard: how late that was is the machine's load
    assert left.short_s < 2.0
    assert wrong(left) == []
    assert left.code in (0, 1, 2)     # 2: killed before a sample came after the mark
    if moment_s > 1:
        leg, = left.legs
        assert round(leg['start'] * 1e3) == round(left.start_ns * 1e-6)
        assert leg['stop'] - leg['start'] > 10 * (left.told_s - 2.0)
        assert 'the leg has no stop mark' in left.text
        assert 'STOP_MARK_MISSING' in {r['code'] for r in leg['reasons']}


def test_pulses_without_stamps_keep_the_times_they_were_sent_at(start, connect, tmp_path):
    made = straight(odometer='counts', imu_grade='industrial')
    start('-p', 'leg.min_distance:=3.0', '-p', 'output.autosave:=false')
    client = connect()
    player = Player(client.node, {'imu': 'sensor_msgs/msg/Imu',
                                  'odometer': 'std_msgs/msg/Int64',
                                  'fix': 'sensor_msgs/msg/NavSatFix'})
    wait_for(player.matched, 'subscriptions')

    def stamped(shift_ns):
        def moved(samples):
            return replace(samples, stamp_ns=samples.stamp_ns + shift_ns,
                           received_ns=samples.received_ns + shift_ns)
        return sorted((one for slot, topic in (
            ('imu', encode.imu('imu/data', moved(made.imu))),
            ('odometer', encode.counter('odometer', moved(made.odometer))),
            ('fix', encode.fix('fix', moved(made.fix)))) for one in sent_of(slot, topic)),
            key=lambda one: one.stamp_ns)

    # stamped by now, as of a real vehicle: counts are stamped by their sender's clock, and clocks
    # half a second apart start no leg. It drives on while services are asked, however long they
    # take
    begin_ns, sent = by_now(lambda begin_ns: part(
        stamped(begin_ns - int(made.imu.stamp_ns[0]) - 70_000_000_000), 70, 170))
    time.sleep(max(0.0, (begin_ns - time.time_ns()) * 1e-9))
    with player.playing(sent, 1):
        client.until(state='idle')
        client.start()
        wait_for(lambda: float(client.status['distance_m']) > 50.0, 'fifty metres driven')
        client.result(client.ask('stop_leg'))
    journal = Path(client.status['journal'])
    assert client.call('save').success
    wait_for((journal / 'metadata.yaml').exists, 'the joined journal')
    folder, = (p for p in tmp_path.iterdir() if p.name[0] == '2' and not p.is_symlink())
    live = json.loads((folder / 'calibration.json').read_text())
    assert live['result']['scale_factor']['value'] > 0
    check_replay(live, journal)


@pytest.fixture(scope='module')
def slow():
    """Return light messages: 100 s of rest and motion."""
    types, sent = messages_of(simulate(SimOptions(
        duration=180.0, imu_rate=20.0, odometer_rate=10.0, odometer='speed')))
    return types, part(sent, 45, 145)


def test_a_folder_that_cannot_be_written_is_a_warning_and_no_more(start, connect, slow, tmp_path):
    (tmp_path / 'file').touch()
    node = start('-p', f'output.directory:={tmp_path}/file', '-p', 'output.autosave:=false')
    client = connect()
    player = recording(client, slow, 0, 10, SPEED)
    player.play(part(slow[1], 10, 55), SPEED)
    status = wait_for(lambda: client.status['journal_trouble'] and client.status, 'the warning')
    assert (status['state'], status['level']) == ('recording', b'\x01')
    assert 'Not a directory' in status['journal_trouble']
    assert 'the journal cannot be written: ' in status['message']
    assert 'output.directory' in status['message']
    stopping = client.ask('stop_leg')
    player.play(part(slow[1], 55, 60), SPEED)
    assert 'scale factor' in client.result(stopping).message
    assert node.text.count('the journal cannot be written') == 1
    assert not client.call('save').success
    status = wait_for(lambda: client.status['save_trouble'] and client.status, 'the other warning')
    assert 'the result is not saved: ' in status['message']
    # and none is missed where none is wanted
    assert client.set(journal__max_bytes=0).successful
    wait_for(lambda: not client.status['journal_trouble'], 'the end of the warning')
    assert client.call('reset').success
    # a busy machine may have forgotten what was sent when it asks: it is sent until a leg begins
    assert any(player.play(part(slow[1], t, t + 1), SPEED) or client.call('start_leg').success
               for t in range(60, 100))
    status = client.until(state='recording')
    assert [status[k] for k in ('journal', 'journal_trouble', 'save_trouble', 'level')] == [
        '', '', '', b'\0']


def test_a_disk_full_for_a_while_costs_nothing_nor_does_the_end_of_the_node(start, connect, slow):
    node = start()
    client = connect()
    player = recording(client, slow, 0, 10, SPEED)
    journal = Path(wait_for(lambda: client.status['journal'], 'the journal'))
    # what a full disk does, without one: no file may grow beyond some bytes
    resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
    player.play(part(slow[1], 10, 40), SPEED)
    status = wait_for(lambda: client.status['journal_trouble'] and client.status, 'the warning')
    assert 'File too large' in status['journal_trouble']
    assert status['level'] == b'\x01'
    resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE,
                     (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    player.play(part(slow[1], 40, 45), SPEED)
    wait_for(lambda: not client.status['journal_trouble'], 'the end of the warning')
    assert node.end() == 0
    assert (journal / f'{journal.name}_0.mcap').exists()
    assert set(np.diff(stamps_of(journal, '/imu/data'))) == {50_000_000}
    left = remains(journal, 0.0, time.time_ns(), int(status['leg_start_ns']))
    assert (left.marks, left.files) == ([(left.start_ns, 0)], 1)
    assert left.code in (0, 1)
    assert 'the leg has no stop mark' in left.text
