# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two wheels on one JointState topic, over DDS: what is told before, during and after a leg."""

import re
from types import SimpleNamespace

from bench import given, wait_for
from player import messages_of, part, playing_to
import pytest

from odocal_ros.bagio import encode
from odocal_ros.live.answers import TURNS
from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 30.0
REST_S = 30.0            # of the drive played before the mark


@pytest.fixture(scope='module')
def drive():
    return simulate(SimOptions(
        scenario='town', duration=240.0, imu_rate=50.0, odometer_rate=25.0, fix_noise='rtk',
        imu_grade='tactical', odometer='angle', two_wheels=True, heading=0.7, seed=4))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    folder = tmp_path_factory.mktemp('two')
    # no setting says which joints are the wheels: their names do
    wheels = {'left_steering': drive.odometer_right, 'right_steering': drive.odometer,
              'wheel_left': drive.odometer, 'wheel_right': drive.odometer_right}
    types, sent = messages_of(drive, odometer=encode.joints('odometer', wheels))
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    settings = {'output.directory': folder, 'method': 'wheels',
                'alignment.heading': drive.truth.heading, 'alignment.heading_sigma': 0.002,
                'wheels.radius': 0.3, 'imu.grade': 'tactical'}
    seen = SimpleNamespace()
    with playing_to(types, *given(settings)) as (_, client, player):
        player.play(part(sent, start_s - REST_S, start_s), SPEED)
        seen.idle = client.until(state='idle')
        seen.start = client.call('start_leg')
        seen.first = client.until(state='recording')
        player.play(part(sent, start_s, start_s + 160), SPEED)
        seen.looked = wait_for(
            lambda: client.status['track_width_ok'] != 'unknown' and client.status,
            'a look at the wheels')
        stopping = client.ask('stop_leg')
        client.until(state='computing')
        player.play(part(sent, start_s + 160, start_s + 163), SPEED)
        # inputs that are silent while it is computed would be the hint
        with player.playing(part(sent, start_s + 163, 240), 1.0):
            seen.stop = client.result(stopping)
            seen.result = wait_for(lambda: client.status['state'] in ('calibrated', 'rejected')
                                   and client.status, 'the result')
        yield seen


def test_the_start_says_what_to_drive_and_what_it_can_tell(session):
    assert session.start.success
    text = session.start.message
    assert re.search(r'drive 1?\d\d m more, faster than leg.min_speed, 2.78 m/s \(10 km/h\), ',
                     text)
    assert TURNS in text
    assert 'then stand still 10 s and call ~/stop_leg' in text
    assert text.endswith(
        'With these settings, observable: the scale, the yaw (from stops, starts and turns), '
        'the pitch, left and right wheel and the track width (in turns)')
    assert session.first['hint'].split(', ', 1)[1] in text        # the same text in the status
    assert session.first['can_tell'].startswith('the scale, the yaw (from')
    assert (session.first['cannot_tell'], session.first['track_width_ok']) == ('', 'unknown')
    assert TURNS in session.first['manoeuvres']


def test_while_it_is_driven_each_quantity_is_yes_or_no(session):
    seen = session.looked
    assert seen['state'] == 'recording'
    found = {name: seen[f'{name}_ok'] for name in (
        'scale', 'yaw', 'pitch', 'left_right', 'track_width')}
    assert set(found.values()) <= {'yes', 'no'}
    assert (found['track_width'] == 'yes') == (TURNS not in seen['hint'])


def test_the_stop_answers_with_both_wheels_and_how_good_each_quantity_is(session, drive):
    assert session.stop.success
    text, status = session.stop.message, session.result
    for words in ('scale factor 0.', ', left 0.', ', right 0.', ', track width 1.', ' OK: scale'):
        assert words in text, text
    assert status['hint'] in text                                 # the same text in the status
    truth = drive.truth
    for name, true in zip(('left', 'right'), truth.wheel_scales, strict=True):
        value, sigma = (float(status[f'scale_factor_{name}{end}']) for end in ('', '_sigma'))
        assert abs(value - true) < 4 * sigma        # 1 in 16000 by chance
    width, sigma = float(status['track_width_m']), float(status['track_width_sigma_m'])
    assert abs(width - drive.options.track_width) < 4 * sigma
    assert (status['left_right_ok'], status['track_width_ok']) == ('yes', 'yes')
    assert 'OK: scale' in status['message']
