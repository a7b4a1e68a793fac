# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A robot with skid steering over DDS: the node and a replay of its journal give the same."""

from bench import given
from kills import replayed, same_result
from player import part, playing_to, sent_of, stopped
import pytest

from odocal_ros.bagio import encode
from odocal_ros.sim.scenarios import SimOptions, simulate
from odocal_ros.sim.wheels import effective_width

SPEED = 20.0
NAMES = {'fix': '/mocap', 'odometer': '/joint_states'}


@pytest.fixture(scope='module')
def drive():
    """Simulate 90 s of a robot with two wheels that slide in turns."""
    return simulate(SimOptions(scenario='indoor', duration=90.0, imu_rate=50.0, drive='skid',
                               odometer='angle', odometer_rate=25.0, reference='mocap',
                               fix_rate=10.0, slip_walk=5e-4, seed=3))


@pytest.fixture(scope='module')
def session(drive, tmp_path_factory):
    """Drive one leg; keep what the node said and wrote."""
    topics = {'imu': encode.imu('imu/data', drive.imu),
              'odometer': encode.joints('joint_states', dict(zip(
                  drive.joints, drive.wheels, strict=True))),
              'fix': encode.pose('mocap', drive.fix, drive.positions())}
    sent = sorted((one for slot, topic in topics.items() for one in sent_of(slot, topic)),
                  key=lambda one: one.stamp_ns)
    start_s = (drive.leg().start_ns - sent[0].stamp_ns) * 1e-9
    settings = {'output.directory': tmp_path_factory.mktemp('skid'), 'leg.preroll': 20.0,
                'odometer.drive': 'skid', 'odometer.left': drive.joints[0],
                'odometer.right': drive.joints[1]}
    types = {slot: topic.msgtype for slot, topic in topics.items()}
    with playing_to(types, *given(settings), '-r', 'fix:=/mocap', '-r', 'odometer:=/joint_states',
                    names=NAMES) as (node, client, player):
        player.play(part(sent, start_s - 4, start_s), SPEED)
        client.start()
        player.play(part(sent, start_s, start_s + 80), SPEED)
        seen = stopped(client, player, part(sent, start_s + 80, start_s + 83), SPEED)
        seen.node = node
        yield seen


def test_a_leg_finds_the_effective_width(session, drive):
    assert session.stop.success, session.stop.message
    width = session.live['result']['track_width']
    assert width['method'] == 'planar'
    true = effective_width(drive.options)
    assert abs(width['value'] - true) < 4 * width['sigma'] < 0.02 * true
    assert 'Traceback' not in session.node.text


def test_its_journal_replays_to_the_last_bit(session):
    code, offline, said = replayed(session.journal)
    assert code == 0, said
    same_result(session.live, offline, 'config')
