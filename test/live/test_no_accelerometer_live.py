# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg by an IMU without accelerometer, over DDS: what is told of it, and replay's figures."""

from dataclasses import replace

from bench import given
from kills import check_replay
import numpy as np
from player import messages_of, part, playing_to, stopped, straight
import pytest

SPEED = 15.0
FIRST_S, MARK_S, STOP_S, END_S = 45, 60, 115, 117     # of the drive: played, and the leg


@pytest.fixture(scope='module')
def drive():
    """Simulate a straight drive, all stamped; the IMU sends zeros for its acceleration."""
    made = straight(imu_grade='industrial')
    return replace(made, imu=replace(made.imu, f_i=np.zeros_like(made.imu.f_i)))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive one leg; keep what the node said."""
    types, sent = messages_of(drive)
    settings = {'output.directory': tmp_path_factory.mktemp('out')}
    with playing_to(types, *given(settings)) as (_, client, player):
        player.play(part(sent, FIRST_S, MARK_S), SPEED)
        client.until(state='idle')
        start = client.call('start_leg')
        player.play(part(sent, MARK_S, STOP_S), SPEED)
        seen = stopped(client, player, part(sent, STOP_S, END_S), SPEED)
        seen.start = start
        return seen


def test_the_start_says_what_the_leg_cannot_tell(session):
    assert session.start.success, session.start.message
    assert 'observable: the scale; not observable: the yaw' in session.start.message
    assert 'the pitch (IMU without acceleration)' in session.start.message


def test_the_stop_gives_the_scale_and_says_what_the_angles_need(session, drive):
    assert session.stop.success, session.stop.message
    assert 'NO_ACCELEROMETER' in session.stop.message
    assert 'NO_IMU' not in session.stop.message
    scale = session.live['result']['scale_factor']
    assert abs(scale['value'] - drive.truth.scale) < 3 * scale['sigma']


def test_it_is_what_replay_finds(session):
    check_replay(session.live, session.journal)
