# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Four wheels on one JointState topic, over DDS: the node and its journal give the same result."""

from bench import given
from kills import replayed, same_result
from player import part, playing_to, sent_of, stopped
import pytest

from odocal_ros.bagio import encode
from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 30.0
REST_S = 30.0            # of the drive played before the mark
SIGMAS = 4.0             # 1 in 16 000 of a normal error; the seed is fixed


@pytest.fixture(scope='module')
def drive():
    """Simulate some minutes of town with four wheels, the front ones of which steer."""
    return simulate(SimOptions(
        scenario='town', duration=240.0, imu_rate=50.0, odometer_rate=25.0, fix_noise='rtk',
        imu_grade='tactical', wheels=4, heading=0.7, seed=4))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive one leg; keep what the node said."""
    folder = tmp_path_factory.mktemp('four')
    wheels = dict(zip(drive.joints, drive.wheels, strict=True))
    topics = {'imu': encode.imu('imu/data', drive.imu), 'fix': encode.fix('fix', drive.fix),
              'odometer': encode.joints('odometer', {'steering': drive.odometer, **wheels})}
    sent = sorted((one for slot, topic in topics.items() for one in sent_of(slot, topic)),
                  key=lambda one: one.stamp_ns)
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    settings = {'output.directory': folder, 'method': 'smoother', 'imu.grade': 'tactical',
                'odometer.wheels': f'[{", ".join(drive.joints)}]'}
    types = {slot: topic.msgtype for slot, topic in topics.items()}
    with playing_to(types, *given(settings)) as (_, client, player):
        player.play(part(sent, start_s - REST_S, start_s), SPEED)
        client.until(state='idle')
        client.start()
        player.play(part(sent, start_s, start_s + 160), SPEED)
        return stopped(client, player, part(sent, start_s + 160, start_s + 163), SPEED)


def test_the_journal_gives_the_same_result_to_the_last_bit(session):
    code, result, said = replayed(session.journal)
    assert code == 0, said
    same_result(session.live, result, 'config')


def test_status_and_answer_have_each_wheel_by_its_name(session, drive):
    assert session.stop.success
    for name, true in zip(drive.joints, drive.truth.wheel_scales, strict=True):
        assert f', {name} 0.3' in session.stop.message
        value, sigma = (float(session.status[f'scale_factor_{name}{end}'])
                        for end in ('', '_sigma'))
        assert abs(value - true) < SIGMAS * sigma
        assert session.live['result'][f'scale_factor_{name}']['value'] == value
    assert session.status['left_right_ok'] == 'unknown'
    assert 'WHEELS_STEERED' in session.status['reasons']
