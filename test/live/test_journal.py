# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The journal of a real node: identical replay, killed node, undone legs, full disk."""

from pathlib import Path
import resource
import time

from bench import wait_for
from kills import check_replay, drive, killed, remains, replayed, same_result, stamps_of, wrong
import numpy as np
from player import by_now, ends_of, light, messages_of, moved, playing_to, straight
import pytest

from odocal_ros.bagio import encode

pytestmark = pytest.mark.slow
NAMES = {'imu': '/front/imu', 'fix': '/gps/fix'}


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """Drive three legs with one node: kept, cancelled, undone."""
    drive = straight(heading=0.7)
    settings = {'output.directory': tmp_path_factory.mktemp('journal'), 'leg.preroll': 20.0,
                'alignment.heading_source': 'fixed', 'alignment.heading': drive.truth.heading}
    with playing_to(messages_of(drive), settings, names=NAMES) as leg:
        client = leg.client

        def another(journal):
            return Path(wait_for(lambda: client.status['journal'] != str(journal)
                                 and client.status['journal'], 'another journal'))
        leg.record(30, 60, 115)
        seen = leg.stopped(115)
        # a cancelled leg, and a leg undone after its journal was joined
        leg.record(117, 118, 122)
        client.call('cancel_leg')
        seen.cancelled = another(seen.journal)
        leg.record(122, 123, 125)
        leg.ended(125)
        seen.undone = another(seen.cancelled)
        wait_for((seen.undone / 'metadata.yaml').exists, 'its end')
        client.call('undo_leg')
        wait_for((seen.undone / f'{seen.undone.name}_1.mcap').exists, 'the mark')
    return seen


def test_the_replay_of_a_journal_is_identical_without_options(session):
    stderr = check_replay(session.live, session.journal)
    assert session.live['inputs'][0]['topics'] == {
        'imu': '/front/imu', 'odometer': '/odometer', 'fix': '/gps/fix'}
    assert 'is a journal: settings and topics come from' in stderr


def test_a_journal_is_one_bag_with_the_preroll_and_each_message_once(session):
    assert sorted(p.name for p in session.journal.iterdir()) == [
        f'{session.journal.name}_0.mcap', 'journal.yaml', 'metadata.yaml']
    start_ns, stop_ns = ends_of(session.status)
    stamps = stamps_of(session.journal, '/front/imu')
    assert set(np.diff(stamps)) == {20_000_000}
    assert start_ns - stamps[0] >= 20_000_000_000     # the configured pre-roll
    assert stamps[-1] > stop_ns


def test_options_take_precedence_over_the_settings_of_a_journal(session):
    code, result, _ = replayed(session.journal, '--set', 'leg.min_distance=5000')
    assert code == 1
    assert result['config']['leg.min_distance'] == 5000.0


def test_cancelled_and_undone_legs_are_not_replayed(session):
    for journal in (session.cancelled, session.undone):
        code, result, stderr = replayed(journal)
        assert (code, result) == (2, None)
        assert 'cancelled or undone' in stderr
        assert '--leg :' in stderr
    assert replayed(session.undone, '--leg', ':')[1] is not None
    code, result, stderr = replayed(session.undone, str(session.journal))
    assert code == 0, stderr
    assert 'cancelled or undone' in stderr
    same_result(session.live, result, 'config')


@pytest.mark.parametrize('moment_s', [0.3, 1.3, 2.6])
def test_the_leg_of_a_killed_node_is_replayed_from_its_start_mark(tmp_path, moment_s):
    left = killed(drive(), moment_s, tmp_path)
    assert left.marks == [(left.start_ns, 0)]
    # one second by design, counted from the received messages, which a busy machine delays
    assert left.short_s < 2.0
    assert wrong(left) == []
    assert left.code in (0, 1, 2)     # 2: killed before a sample came after the mark
    if moment_s > 1:
        leg, = left.legs
        assert round(leg['start'] * 1e3) == round(left.start_ns * 1e-6)
        assert leg['stop'] - leg['start'] > 10 * (left.leg_s - 2.0)
        assert 'the leg has no stop mark' in left.text
        assert 'STOP_MARK_MISSING' in {r['code'] for r in leg['reasons']}


def test_pulses_without_stamps_keep_the_times_of_their_sender(play_to):
    made = straight(odometer='counts', imu_grade='industrial')

    def stamped(by_ns):
        return messages_of(made, imu=encode.imu('imu/data', moved(made.imu, by_ns)),
                           odometer=encode.counter('odometer', moved(made.odometer, by_ns)),
                           fix=encode.fix('fix', moved(made.fix, by_ns)))

    leg = play_to(stamped(0), {'leg.min_distance': 3.0}, 1)
    wait_for(leg.player.matched, 'subscriptions')
    # stamped with the present time, as on a real vehicle: counts have the clock of their sender,
    # and no leg starts with clocks half a second apart. The drive continues during service calls,
    # whatever their duration
    begin_ns, (_, leg.sent) = by_now(lambda begin_ns: stamped(
        begin_ns - int(made.imu.stamp_ns[0]) - 70_000_000_000))
    client = leg.client
    time.sleep(max(0.0, (begin_ns - time.time_ns()) * 1e-9))
    with leg.playing(70, 170):
        client.until(state='idle')
        client.start()
        wait_for(lambda: float(client.status['distance_m']) > 50.0, 'fifty metres driven')
        client.result(client.ask('stop_leg'))
    assert client.call('save').success
    seen = leg.written()
    assert seen.live['result']['scale_factor']['value'] > 0
    check_replay(seen.live, seen.journal)


def test_no_message_is_lost_by_a_temporarily_full_disk_or_the_end_of_the_node(play_to):
    leg = play_to(light(45, 145), speed=30.0)
    leg.record(0, 10)
    client, limit = leg.client, (resource.RLIM_INFINITY,) * 2
    journal = Path(wait_for(lambda: client.status['journal'], 'the journal'))
    # simulates a full disk: no file may exceed some bytes
    resource.prlimit(leg.node.process.pid, resource.RLIMIT_FSIZE, (100, limit[1]))
    leg.play(10, 40)
    status = wait_for(lambda: client.status['journal_error'] and client.status, 'the warning')
    assert 'File too large' in status['journal_error']
    assert status['level'] == b'\x01'
    resource.prlimit(leg.node.process.pid, resource.RLIMIT_FSIZE, limit)
    leg.play(40, 45)
    wait_for(lambda: not client.status['journal_error'], 'the end of the warning')
    assert leg.node.end() == 0
    assert (journal / f'{journal.name}_0.mcap').exists()
    assert set(np.diff(stamps_of(journal, '/imu/data'))) == {50_000_000}
    left = remains(journal, 0.0, time.time_ns(), int(status['leg_start_ns']))
    assert (left.marks, left.files) == ([(left.start_ns, 0)], 1)
    assert left.code in (0, 1)
    assert 'the leg has no stop mark' in left.text
