# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg that a jump of time cancels: the operator is told, and its journal is computed."""

from pathlib import Path
import shlex

from bench import wait_for
from kills import replayed
from player import messages_of, part, Player, straight
import pytest

from odocal_ros.bagio.read import open_bag
from odocal_ros.library.asked import parse_leg
from odocal_ros.live.journal import replay_command

SPEED = 30.0


@pytest.mark.parametrize('journal', [True, False])
def test_a_leg_lost_to_a_jump_of_time_is_said_and_computed_from_its_journal(
        start, connect, journal):
    drive = straight(heading=0.7)
    types, sent = messages_of(drive)
    node = start('-p', 'alignment.heading_source:=fixed', '-p',
                 f'alignment.heading:={drive.truth.heading!r}', '-p',
                 f'journal.max_bytes:={10**9 * journal}')
    client = connect()
    player = Player.connected(client, types)
    player.play(part(sent, 30, 60), SPEED)
    client.until(state='idle')
    started = int(client.until(leg_event='')['leg_start_ns']), client.start()
    assert started[1].success
    player.play(part(sent, 60, 115), SPEED)
    mark_ns = int(client.status['leg_start_ns'])
    # a busy machine takes its time to hear what was sent before the jump
    wait_for(lambda: float(client.status['duration_s']) > 54.0, 'the last of the leg')
    player.play(part(sent, 100, 101), SPEED)
    status = client.until(leg_event='cancelled')
    answer = client.call('stop_leg')
    assert not answer.success
    assert answer.message.startswith('leg 1 was cancelled: time jumped back; ')
    status = client.until(lost=answer.message)
    assert answer.message in status['message']
    assert status['level'] == b'\x01'
    if not journal:
        assert 'it has no journal' in answer.message
    else:
        command = answer.message.partition('compute it with ')[2].partition(';')[0]
        odocal, replay, folder, option, leg = shlex.split(command)
        assert (odocal, replay, folder, option) == ('odocal', 'replay', status['journal'], '--leg')
        wait_for((Path(folder) / 'metadata.yaml').exists, 'the joined journal')
        with open_bag(Path(folder)) as bag:     # nothing of the time after the jump
            times = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
                     for _, m in bag.messages('/imu/data')]
        assert times == sorted(times)
        code, result, said = replayed(Path(folder))
        assert (code, result) == (2, None)      # it was cancelled: not without being asked
        code, result, said = replayed(Path(folder), option, leg)
        assert code == 0, said
        one, = result['legs']
        assert abs(one['start_ns'] - mark_ns) < 1000
        # 54 s of 55 were heard before the jump, and a journal may lack the last second
        assert 53e9 < one['stop_ns'] - mark_ns < 56e9
        scale = result['result']['scale_factor']
        assert abs(scale['value'] - drive.truth.scale) < 5 * scale['sigma']
    assert f'{answer.message}' in node.text
    player.play(part(sent, 101, 103), SPEED)
    assert client.start().success
    assert client.until(state='recording')['lost'] == ''


@pytest.mark.parametrize('start_ns', [60 * 10**9, 1_700_000_000_123_456_789])
def test_the_command_marks_the_leg_to_the_microsecond_on_any_clock(start_ns):
    *_, leg = shlex.split(replay_command("/a b/it's", start_ns))
    span = parse_leg(leg)
    assert span.stop_ns is None
    assert span.relative == (False, False)
    assert 0 <= start_ns - span.start_ns < 1000
