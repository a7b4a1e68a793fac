# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The IMU falls silent in a leg: said at once, the leg is cut there, its parts make the result."""

from types import SimpleNamespace

from bench import given, wait_for
from kills import NUMBERS, replayed, same_result
from player import messages_of, part, playing_to, stopped
import pytest

from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 30.0
GAP = (100.0, 103.0)       # s of the drive


@pytest.fixture(scope='module')
def seen(tmp_path_factory):
    """Drive a leg with such a gap through a node, and keep what it said."""
    drive = simulate(SimOptions(
        scenario='town', duration=240.0, imu_rate=50.0, odometer_rate=25.0, odometer='speed',
        fix_noise='rtk', imu_grade='industrial'))
    types, sent = messages_of(drive)
    first_ns = sent[0].stamp_ns
    sent = [one for one in sent if one.slot != 'imu'
            or not GAP[0] <= (one.stamp_ns - first_ns) * 1e-9 < GAP[1]]
    found = SimpleNamespace(truth=drive.truth, folder=tmp_path_factory.mktemp('results'))
    # the status comes seldom by itself: what is said at once is seen to be
    settings = {'output.directory': found.folder, 'publish.rate': 0.2}
    with playing_to(types, *given(settings)) as (found.node, client, player):
        player.play(part(sent, 4, 15), SPEED)
        client.start()
        player.play(part(sent, 15, GAP[0]), SPEED)
        wait_for(lambda: client.status['scale_ok'] == 'yes', 'an estimate that is good enough')
        player.play(part(sent, *GAP), 1.0)
        found.silent = client.until(reasons='LEG_CUT')
        player.play(part(sent, GAP[1], 130), SPEED)
        found.told = wait_for(lambda: '3.02 s' in client.status['hint'] and client.status,
                              'the whole gap')
        player.play(part(sent, 130, 190), SPEED)
        seen = stopped(client, player, part(sent, 190, 192), SPEED)
        found.undone = client.call('undo_leg')
        yield SimpleNamespace(**vars(found), **vars(seen))


def test_it_is_said_at_once_and_what_was_good_enough_stays_so(seen):
    assert seen.told['level'] == b'\1'
    assert 'no IMU data for 3.02 s at t = ' in seen.told['hint']
    assert 'the leg is cut there' in seen.told['hint']
    assert 'cancel_leg' not in seen.told['hint']
    warned, = [line for line in seen.node.lines if 'WARN' in line and 'LEG_CUT' in line]
    assert '3.02 s' not in seen.silent['hint']     # it is silent still; 0.95 s on an idle machine
    for told in (seen.silent, seen.told):
        assert told['scale_ok'] == 'yes'
        off = float(told['estimate_scale_factor']) - seen.truth.scale
        assert abs(off) < 4 * float(told['estimate_scale_factor_sigma'])


def test_its_parts_make_the_result_also_of_a_replay(seen):
    assert seen.stop.success
    assert seen.stop.message.startswith('leg 1 in 2 sections, ')
    assert seen.status['legs'] == '1'
    one, other = seen.live['legs']
    assert other['start_ns'] - one['stop_ns'] == pytest.approx(3.02e9, abs=1e6)
    scale = seen.live['result']['scale_factor']
    assert abs(scale['value'] - seen.truth.scale) < 4 * scale['sigma']
    assert 'LEG_CUT' in {r['code'] for r in seen.live['reasons']}
    assert seen.undone.message == 'leg 1 is undone; no leg is left'
    ends_ns = (int(seen.status[f'leg_{end}_ns']) for end in ('start', 'stop'))
    marks = [f'{ns // 10**9}.{ns % 10**9:09}' for ns in ends_ns]
    # undone since: it must be asked for by its marks
    _, offline, _ = replayed(seen.journal, '--leg', ':'.join(marks), *NUMBERS)
    same_result(seen.live, offline)
