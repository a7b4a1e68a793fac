# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""~/mark over DDS: a square from point to point; its journal replays to the same bits."""

from bench import given, wait_for
from kills import check_replay
from player import messages_of, part, playing_to, stopped
import pytest

from odocal_ros.bagio import encode
from odocal_ros.errors import BadUsage
from odocal_ros.library.calibrate_bag import calibrate_bag
from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 20.0
POINTS = (0, 0, 4, 0, 4, 4, 0, 4, 0, 0, 4, 0, 4, -4, 0, -4, 0, 0)
TIMES = (5.0, *(20.5 + 17.0 * k for k in range(8)))     # in the middle of 3 s at rest
SETTINGS = {'odometer.left': 'left', 'odometer.right': 'right', 'leg.preroll': 20.0,
            'verdict.max_scale_sigma': 0.005}


@pytest.fixture(scope='module', params=[True, False], ids=['imu', 'no imu'])
def drive(request):
    return simulate(SimOptions(scenario='square', odometer='angle', imu_rate=50.0,
                               imu=request.param))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive the square, with a mark at each point; keep what the node said."""
    wheels = dict(zip(('left', 'right'), drive.wheels, strict=True))
    imu = encode.imu('imu/data', drive.imu) if drive.options.imu else None
    types, sent = messages_of(drive, imu=imu, odometer=encode.joints('odometer', wheels), fix=None)
    settings = SETTINGS | {
        'output.directory': tmp_path_factory.mktemp('marked'),
        'odometer.nominal_scale': drive.options.nominal_scale,
        'reference.points': f'[{", ".join(f"{x}.0" for x in POINTS)}]'}
    with playing_to(types, *given(settings)) as (node, client, player):
        at, answers = 0.0, []

        def play_to(time):
            nonlocal at
            player.play(part(sent, at, time), SPEED)
            at = time
            wait_for(lambda: client.status.get('duration_s') and client.status, 'a status')
        play_to(3.0)
        client.until(state='idle')
        early = client.call('mark')
        client.start()
        for time in TIMES:
            play_to(time + 1.3)
            answers.append(client.call('mark'))
            if len(answers) == 2:
                second = client.until(state='recording')
            if len(answers) == 1:
                first = client.until(state='recording')
                play_to(14.0)
                turning = client.call('mark')
        seen = stopped(client, player, part(sent, at, at + 3.0), SPEED)
        seen.first, seen.second = first, second
        seen.node, seen.early, seen.turning, seen.answers = node, early, turning, answers
        return seen


def test_marks_are_refused_answered_and_asked_for(session):
    assert not session.early.success
    assert 'call ~/start_leg first, then ~/mark on each point' in session.early.message
    assert not session.turning.success
    assert 'stand on the point and call again' in session.turning.message
    assert all(answer.success for answer in session.answers)
    said = [answer.message for answer in session.answers]
    assert said[0] == 'mark 1 of leg 1: point 1, x 0 m, y 0 m'
    assert said[7] == 'mark 8 of leg 1: point 8, x 0 m, y -4 m'
    assert len(session.status['marks'].split(',')) == len(TIMES)
    assert 'call ~/mark at rest on each point, ' in session.first['hint']
    assert 'call ~/mark' not in session.second['hint']


def test_the_leg_finds_both_wheels_and_the_track_width(session, drive):
    assert session.stop.success, session.stop.message
    result, most = session.live['result'], 3e-3 if drive.options.imu else 4e-3
    for name, true in (('scale_factor_left', drive.truth.wheel_scales[0]),
                       ('scale_factor_right', drive.truth.wheel_scales[1]),
                       ('track_width', drive.options.track_width)):
        found = result[name]
        assert abs(found['value'] - true) < 3 * found['sigma'] < 3 * most * true, name
    codes = {r['code'] for r in session.live['legs'][0]['reasons']}
    assert ('LOCAL_FRAME' in codes) is drive.options.imu


def test_its_journal_replays_to_the_last_bit_and_options_precede_it(session):
    check_replay(session.live, session.journal)
    with pytest.raises(BadUsage, match='--mark 14: the odometer has no data there'):
        calibrate_bag(session.journal, config={'reference.marks': [14.0]})
    with pytest.raises(BadUsage, match='a mark of point [2-9], reference.points has 1: use'):
        calibrate_bag(session.journal, config={'reference.points': [0.0, 0.0]})


def test_without_points_a_mark_is_refused(start, connect):
    start()
    client = connect()
    client.until(state='waiting')
    answer = client.call('mark')
    assert not answer.success
    assert 'reference.points is empty' in answer.message


def test_points_are_pairs(start):
    node = start('-p', 'reference.points:=[1.0, 2.0, 3.0]')
    assert node.wait() != 0
    assert 'reference.points has 3 values; required with marks' in node.text
    assert 'Traceback' not in node.text
