# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Automatic legs: the node starts, ends, combines and saves them, and continues a day later."""

from dataclasses import replace
import json
from pathlib import Path
from types import SimpleNamespace

from bench import wait_for
from kills import NUMBERS, replayed, same_result
from player import ends_of, messages_of, part, playing_to, within
import pytest
import ros_bags

from odocal_ros.sim.scenarios import SimOptions, simulate

SETTINGS = {'leg.automatic': 'true', 'leg.automatic_minutes': '4.0'}
# with best effort, a busy machine at 30 times real time loses too many messages for a leg
RELIABLE = {f'qos_overrides./{topic}.subscription.reliability': 'reliable'
            for topic in ('imu/data', 'odometer', 'fix')}
CHANGE = -0.009            # of the scale, during the standstill
STOP = 189.0               # s: standstill after more than half of leg.automatic_minutes
DAY = 86400 * 10**9


def town(**options):
    return simulate(SimOptions(
        scenario='town', duration=420.0, imu_rate=50.0, odometer_rate=25.0, odometer='speed',
        fix_noise='rtk', imu_grade='industrial', **options))


def softer(drive, since_ns=0):
    """Return a drive with less tyre pressure from since_ns on: a smaller wheel turns more."""
    odometer = drive.odometer
    value = odometer.value / (1 + CHANGE * (odometer.stamp_ns > since_ns))
    return replace(drive, wheels=(replace(odometer, value=value),))


@pytest.fixture(scope='module')
def drive():
    """Simulate two legs in a town, between which the tyres lose air, and a drive a day later."""
    whole = town()
    types, sent = messages_of(softer(whole, whole.imu.stamp_ns[0] + round(STOP * 1e9)))
    later = messages_of(softer(town(start_ns=whole.options.start_ns + DAY, seed=2)))
    return SimpleNamespace(scale=whole.truth.scale, types=types, sent=sent, later=later)


@pytest.fixture(scope='module')
def seen(drive, tmp_path_factory):
    """Run the node twice, and keep its messages."""
    found = SimpleNamespace(folder=tmp_path_factory.mktemp('results'))
    settings = SETTINGS | RELIABLE | {'output.directory': found.folder}
    for run, driven in ((_first, (drive.types, drive.sent)), (_a_day_later, drive.later)):
        with playing_to(driven, settings) as leg, leg.playing(0, 1000):
            run(found, leg.node, leg.client)
    return found


def _first(found, node, client):
    found.node = node
    found.recording = client.until(state='recording', automatic='leg')
    found.one = client.until(legs='1')
    found.next = client.until(state='recording', leg_id='2')
    found.two = client.until(legs='2')
    found.computing = [s for s in client.statuses if s['state'] == 'computing'
                       and s['leg_id'] == '1']
    found.written = wait_for(lambda: _saved(client.status['saved'], 2), 'the second save')


def _saved(folder, legs):
    """Return calibration.json of a result folder, None if its number of legs differs."""
    if not folder:
        return None
    found = json.loads((Path(folder) / 'calibration.json').read_text())
    return found if len(found['legs']) == legs else None


def _a_day_later(found, node, client):
    client.until(state='recording', automatic='leg')
    found.start = client.call('start_leg')
    found.operators = client.until(automatic='started by the operator')
    found.cancel = client.call('cancel_leg')
    found.waits = client.until(automatic='waiting')
    client.until(state='recording', automatic='leg')
    wait_for(lambda: float(client.status['distance_m']) > 500.0, 'half a kilometre')
    found.stop = client.result(client.ask('stop_leg'))
    found.later = client.until(legs='1')
    client.until(state='recording', automatic='leg')       # the next leg
    found.carried = wait_for(lambda: _saved(client.status['saved'], 1), 'the save')['carried']
    found.again = node


def near(status, true):
    """Return True if the scale of a status agrees with the true one."""
    value, sigma = (float(status[f'scale_factor{end}']) for end in ('', '_sigma'))
    return within({'value': value, 'sigma': sigma}, true)


def test_legs_start_and_end_automatically_at_standstills(seen, drive):
    first_ns = drive.sent[0].stamp_ns

    def seconds(status):
        return [(ns - first_ns) / 1e9 for ns in ends_of(status)]
    assert seconds(seen.one) == pytest.approx([19.4, 189.5], abs=0.5)
    assert seconds(seen.two) == pytest.approx([189.5, 361.4], abs=0.5)
    assert seen.next['leg_start_ns'] == seen.one['leg_stop_ns']
    assert 'the leg ends automatically at a standstill, or within' in seen.recording['hint']
    assert 'stop_leg' not in seen.recording['hint'] + seen.two['hint'] + seen.one['hint']
    assert 'ready' in seen.node.text
    assert '~/start_leg' not in seen.node.text


def test_the_status_shows_the_progress_of_the_computation(seen):
    shares = [float(status['computing_percent']) for status in seen.computing]
    assert shares == sorted(shares)
    assert shares[-1] < 100
    for status in seen.computing:
        stage = status['computing_stage'] or 'started'
        assert status['hint'].startswith(f'computing: {stage}')
        assert '%' not in status['hint']
    assert seen.next['computing_percent'] == '0.0'


def test_a_change_of_the_scale_is_reported_and_adopted(seen, drive):
    assert seen.one['level'] == b'\0'
    assert seen.two['level'] == b'\1'
    assert seen.two['reasons'].split(',')[0] == 'SCALE_CHANGED'
    assert 'the scale changed by -0.9' in seen.two['message']
    warned, = [line for line in seen.node.lines if 'WARN' in line and 'SCALE_CHANGED' in line]
    assert 'tyre pressure, wear, load or another tyre' in warned
    assert near(seen.one, drive.scale)
    assert near(seen.two, drive.scale * (1 + CHANGE))


def test_replay_of_a_recording_gives_the_legs_and_the_result_of_the_node(seen, drive, tmp_path):
    topics = {slot: {'imu': '/imu/data'}.get(slot, f'/{slot}') for slot in drive.types}
    (tmp_path / 'bags').mkdir()
    # up to the last message that the node had received when its second leg ended
    recording = ros_bags.write(
        tmp_path / 'bags' / 'one', [(topics[one.slot], one.stamp_ns, one.raw)
                                    for one in part(drive.sent, 0, 364)],
        types={topics[slot]: kind for slot, kind in drive.types.items()})
    options = [x for name, value in SETTINGS.items() for x in ('--set', f'{name}={value}')]
    _, offline, _ = replayed(recording, *options, *NUMBERS)
    written = seen.written
    assert [(leg['start_ns'], leg['stop_ns']) for leg in offline['legs']] \
        == [(leg['start_ns'], leg['stop_ns']) for leg in written['legs']]
    same_result(written, offline, 'carried')


def test_the_node_continues_from_the_saved_result_on_the_next_day(seen, drive):
    assert 'continues ' in seen.again.text
    assert seen.later['carried_legs'] == '2'
    assert seen.carried['legs'] == 3
    latest = json.loads((seen.folder / 'latest' / 'calibration.json').read_text())
    assert latest['carried'] == seen.carried
    assert 'SCALE_CHANGED' not in seen.later['reasons']       # it was reported the day before
    assert near(seen.later, drive.scale * (1 + CHANGE))


def test_commands_of_the_operator_take_precedence_over_automatic_legs(seen):
    assert seen.start.success
    assert seen.start.message.startswith('recording leg 2 since')
    assert int(seen.operators['leg_id']) == 2
    assert 'then drive on' in seen.operators['hint']
    assert seen.cancel.success
    assert 'start driving' in seen.waits['hint']
    assert seen.stop.success
