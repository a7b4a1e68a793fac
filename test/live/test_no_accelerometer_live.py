# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg by an IMU without accelerometer, over DDS: what is told of it, and replay's figures."""

from dataclasses import replace
from types import SimpleNamespace

from bench import given
import numpy as np
from player import messages_of, part, playing_to
import pytest

from odocal_ros.data.leg import LegRecorder
from odocal_ros.messages.decode import make_reader
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.settings.config import Config
from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 15.0
FIRST_S, MARK_S, STOP_S, END_S = 45, 60, 115, 117     # of the drive: played, and the leg


@pytest.fixture(scope='module')
def drive():
    """Simulate a straight drive, all stamped; the IMU sends zeros for its acceleration."""
    made = simulate(SimOptions(scenario='straight', duration=180.0, imu_rate=50.0,
                               odometer_rate=25.0, odometer='speed', fix_noise='rtk'))
    return replace(made, imu=replace(made.imu, f_i=np.zeros_like(made.imu.f_i)))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive one leg; keep what the node said."""
    types, sent = messages_of(drive)
    settings, seen = {'output.directory': tmp_path_factory.mktemp('out')}, SimpleNamespace()
    with playing_to(types, *given(settings)) as (_, client, player):
        player.play(part(sent, FIRST_S, MARK_S), SPEED)
        client.until(state='idle')
        seen.start = client.call('start_leg')
        player.play(part(sent, MARK_S, STOP_S), SPEED)
        stopping = client.ask('stop_leg')
        player.play(part(sent, STOP_S, END_S), SPEED)
        seen.stop = client.result(stopping)
        seen.status = client.until(state='calibrated')
        seen.scale, seen.sigma = client.get('result.scale_factor', 'result.scale_factor_sigma')
        yield seen


def test_the_start_says_what_the_leg_cannot_tell(session):
    assert session.start.success, session.start.message
    assert 'observable: the scale; not observable: the yaw' in session.start.message
    assert 'the pitch (IMU without acceleration)' in session.start.message


def test_the_stop_gives_the_scale_and_says_what_the_angles_need(session, drive):
    assert session.stop.success, session.stop.message
    assert 'NO_ACCELEROMETER' in session.stop.message
    assert 'NO_IMU' not in session.stop.message
    assert abs(session.scale - drive.truth.scale) < 3 * session.sigma


def test_it_is_what_replay_finds(session, drive):
    recorder, config = LegRecorder(), Config()
    types, sent = messages_of(drive)
    received = part(sent, FIRST_S, END_S)
    for slot, msgtype in types.items():
        reader, mine = make_reader(slot, msgtype, config), [m for m in received if m.slot == slot]
        for name, block in reader.rows([m.raw for m in mine], [m.stamp_ns for m in mine], None):
            recorder.feed(name, block)
        recorder.form = reader.form or recorder.form
    leg = recorder.close(int(session.status['leg_start_ns']),
                         int(session.status['leg_stop_ns']), config.leg.preroll)
    scale = combine([calibrate(leg, config)], config).estimates['scale_factor']
    assert (session.scale, session.sigma) == (scale.value, scale.sigma)
