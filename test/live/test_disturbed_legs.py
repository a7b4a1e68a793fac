# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs with a gap, a jump of time or two IMUs on a topic: immediate reports, and results."""

from contextlib import ExitStack
from pathlib import Path
import shlex
from types import SimpleNamespace

from bench import given, NodeProcess, wait_for
from kills import NUMBERS, replayed, same_result, stamps_of
from player import ends_of, messages_of, playing_to, Sent, straight, within
import pytest

from odocal_ros.library.arguments import parse_leg
from odocal_ros.live.journal import replay_command
from odocal_ros.messages.cdr import FRAME_OFFSET
from odocal_ros.sim.scenarios import SimOptions, simulate

GAP = (100.0, 103.0)       # s of the drive
WORDS = "contains messages of several IMUs (frame_id 'imu_link' and 'rmu_link'): set imu.frame_id"


@pytest.fixture(scope='module')
def gap(tmp_path_factory):
    """Drive a leg with a gap in the IMU data, and keep the messages of the node."""
    drive = simulate(SimOptions(
        scenario='town', duration=240.0, imu_rate=50.0, odometer_rate=25.0, odometer='speed',
        fix_noise='rtk', imu_grade='industrial'))
    types, sent = messages_of(drive)
    first_ns = sent[0].stamp_ns
    sent = [one for one in sent if one.slot != 'imu'
            or not GAP[0] <= (one.stamp_ns - first_ns) * 1e-9 < GAP[1]]
    # with this low rate of the status, immediate reports are visible as such
    settings = {'output.directory': tmp_path_factory.mktemp('results'), 'publish.rate': 0.2}
    with playing_to((types, sent), settings) as leg:
        client = leg.client
        leg.play(4, 15)
        client.start()
        leg.play(15, GAP[0])
        wait_for(lambda: client.status['scale_ok'] == 'yes', 'an estimate that is good enough')
        leg.play(*GAP, speed=1.0)
        silent = client.until(reasons='LEG_CUT')
        leg.play(GAP[1], 130)
        status_with_gap = wait_for(lambda: '3.02 s' in client.status['hint'] and client.status,
                                   'the whole gap')
        leg.play(130, 190)
        seen = leg.stopped(190)
        return SimpleNamespace(truth=drive.truth, silent=silent, status_with_gap=status_with_gap,
                               undone=client.call('undo_leg'), **vars(seen))


def test_a_gap_is_reported_immediately_and_a_sufficient_scale_stays_sufficient(gap):
    assert gap.status_with_gap['level'] == b'\1'
    assert 'no IMU data for 3.02 s at t = ' in gap.status_with_gap['hint']
    assert 'the leg is cut there' in gap.status_with_gap['hint']
    assert 'cancel_leg' not in gap.status_with_gap['hint']
    warned, = [line for line in gap.node.lines if 'WARN' in line and 'LEG_CUT' in line]
    assert '3.02 s' not in gap.silent['hint']     # the gap continues; 0.95 s on an idle machine
    for status_with_gap in (gap.silent, gap.status_with_gap):
        assert status_with_gap['scale_ok'] == 'yes'
        value, sigma = (float(status_with_gap[f'estimate_scale_factor{end}'])
                        for end in ('', '_sigma'))
        assert within({'value': value, 'sigma': sigma}, gap.truth.scale)


def test_node_and_replay_calibrate_a_leg_with_a_gap_from_its_sections(gap):
    assert gap.stop.success
    assert gap.stop.message.startswith('leg 1 in 2 sections, ')
    assert gap.status['legs'] == '1'
    one, other = gap.live['legs']
    assert other['start_ns'] - one['stop_ns'] == pytest.approx(3.02e9, abs=1e6)
    assert within(gap.live['result']['scale_factor'], gap.truth.scale)
    assert 'LEG_CUT' in {r['code'] for r in gap.live['reasons']}
    assert gap.undone.message == 'leg 1 is undone; no leg is left'
    marks = [f'{ns // 10**9}.{ns % 10**9:09}' for ns in ends_of(gap.status)]
    # the leg is undone: replay needs its marks
    _, offline, _ = replayed(gap.journal, '--leg', ':'.join(marks), *NUMBERS)
    same_result(gap.live, offline)


@pytest.mark.parametrize('journal', [True, False])
def test_a_leg_cancelled_by_a_time_jump_is_reported_and_replayed(play_to, journal):
    drive = straight(heading=0.7)
    leg = play_to(messages_of(drive), {
        'alignment.heading_source': 'fixed', 'alignment.heading': drive.truth.heading,
        'journal.max_bytes': 10**9 * journal}, 30.0)
    leg.record(30, 60, 115)
    client, mark_ns = leg.client, int(leg.client.status['leg_start_ns'])
    # a busy machine receives late what was sent before the jump
    wait_for(lambda: float(client.status['duration_s']) > 54.0, 'the last of the leg')
    leg.play(100, 101)
    client.until(leg_event='cancelled')
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
        odocal, replay, folder, option, mark = shlex.split(command)
        assert (odocal, replay, folder, option) == ('odocal', 'replay', status['journal'], '--leg')
        folder = Path(folder)
        wait_for((folder / 'metadata.yaml').exists, 'the joined journal')
        times = stamps_of(folder, '/imu/data')
        assert times == sorted(times)           # no message from after the jump
        code, result, _ = replayed(folder)
        assert (code, result) == (2, None)      # cancelled: replayed only on request
        code, result, stderr = replayed(folder, option, mark)
        assert code == 0, stderr
        one, = result['legs']
        assert abs(one['start_ns'] - mark_ns) < 1000
        # 54 s of 55 were received before the jump, and a journal may lack the last second
        assert 53e9 < one['stop_ns'] - mark_ns < 56e9
        assert within(result['result']['scale_factor'], drive.truth.scale, 5)
    assert answer.message in leg.node.text
    leg.play(101, 103)
    assert client.start().success
    assert client.until(state='recording')['lost'] == ''


@pytest.mark.parametrize('start_ns', [60 * 10**9, 1_700_000_000_123_456_789])
def test_the_replay_command_gives_the_start_mark_to_a_microsecond_on_any_clock(start_ns):
    *_, leg = shlex.split(replay_command("/a b/it's", start_ns))
    span = parse_leg(leg)
    assert span.stop_ns is None
    assert not span.start_is_relative
    assert not span.stop_is_relative
    assert 0 <= start_ns - span.start_ns < 1000


def test_two_imus_on_a_topic_are_reported_by_both_nodes_and_reject_the_leg(tmp_path):
    types, sent = messages_of(straight(imu_grade='industrial'))
    other = {one.stamp_ns for one in [one for one in sent if one.slot == 'imu'][1::2]}
    sent = [Sent(one.stamp_ns, one.slot,
                 one.raw[:FRAME_OFFSET] + b'r' + one.raw[FRAME_OFFSET + 1:])
            if one.slot == 'imu' and one.stamp_ns in other else one for one in sent]
    odometry = NodeProcess(*given({
        'result.scale_factor': 1.0, 'result.scale_factor_sigma': 0.001, 'result.valid': True}),
        module='odometry')
    with ExitStack() as ends:
        ends.callback(odometry.end)
        leg = ends.enter_context(playing_to((types, sent), {'output.directory': tmp_path}, 15.0))
        wait_for(lambda: leg.player.publishers['imu'].get_subscription_count() == 2, 'both nodes')
        leg.record(45, 60, 115)
        recording = leg.client.status
        stop = leg.ended(115)
        status = leg.client.until(state='rejected')
        wait_for(lambda: 'several IMUs' in odometry.text, f'a word: {odometry.text}')
    assert WORDS in recording['message']
    assert recording['level'] == b'\1'
    assert leg.node.text.count(WORDS) == odometry.text.count(WORDS) == 1
    assert not stop.success
    assert 'SEVERAL_IMUS' in stop.message
    assert "imu.frame_id: 'imu_link'" in stop.message
    assert 'SEVERAL_IMUS' in status['reasons']
