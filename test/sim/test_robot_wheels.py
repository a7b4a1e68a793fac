# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wheels of simulated robots: skid steering, mecanum wheels, no IMU."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.errors import BadUsage
from odocal_ros.library.read_bag import read_bag
from odocal_ros.sim.robot_wheels import effective_width, robot_path, SIDEWAYS, SPOT, STRAIGHT
from odocal_ros.sim.scenarios import SimOptions, simulate
from odocal_ros.sim.vehicle_wheels import wheels_of

pytestmark = pytest.mark.core


def robot(**options):
    return simulate(SimOptions(scenario='indoor', duration=100.0, odometer='angle', **options))


def paths(made):
    """Return a fine state, and the metres that each wheel has rolled by name of the wheel."""
    state = made.motion.at(np.arange(0.0, made.motion.duration, 0.01))
    return state, {one.name: robot_path(state, made.options, one)
                   for one in wheels_of(made.options)}


def test_skid_wheels_turn_by_the_effective_width_on_the_spot():
    made = robot(drive='skid', wheels=2)
    state, rolled = paths(made)
    spot = (state.speed == 0.0) & (state.yaw_rate != 0.0)
    apart = np.diff(rolled['right_wheel_joint'] - rolled['left_wheel_joint'])
    turns = np.diff(state.turned)
    assert effective_width(made.options) == pytest.approx(SPOT * 0.3)
    assert_allclose(apart[spot[:-1] & spot[1:]], SPOT * 0.3 * turns[spot[:-1] & spot[1:]],
                    rtol=1e-9, atol=1e-12)
    wide = effective_width(made.options, 1e9)
    assert wide == pytest.approx(STRAIGHT * 0.3)


def test_mecanum_wheels_obey_their_kinematics():
    """The sums of the four wheels are forward motion, sideways motion and turn."""
    made = robot(drive='mecanum')
    state, rolled = paths(made)
    fl, fr, rl, rr = (rolled[f'{a}_{b}'] for a in ('front', 'rear') for b in ('left', 'right'))
    lateral = np.append(0.0, np.cumsum(0.01 * (state.sway[1:, 0] + state.sway[:-1, 0]) / 2))
    assert lateral.max() > 1.0
    assert_allclose((fl + fr + rl + rr) / 4, state.travel, atol=1e-9)
    assert_allclose((-fl + fr + rl - rr) / 4, lateral / SIDEWAYS, atol=1e-9)
    assert_allclose((-fl + fr - rl + rr) / 4, effective_width(made.options) / 2 * state.turned,
                    atol=1e-9)


def test_positions_of_a_mecanum_robot_move_sideways():
    """The path of the reference has the sideways moves."""
    made = robot(drive='mecanum', reference='mocap')
    path = np.linalg.norm(np.diff(made.positions()[:, :2][::10], axis=0), axis=1).sum()
    assert path > 1.2 * made.truth.distance


def test_a_robot_without_an_imu_sends_none_and_can_be_read(tmp_path):
    made = robot(imu=False)
    assert not len(made.leg().imu.stamp_ns)
    bag = write_bag(tmp_path / 'bag', drive_topics(made))
    two = {'odometer.left': 'left_wheel_joint', 'odometer.right': 'right_wheel_joint'}
    found = read_bag(bag, config=two)
    assert 'imu' not in found.topics
    assert len(found.samples('odometer').stamp_ns)
    with pytest.raises(BadUsage, match='no IMU'):
        read_bag(bag)       # wheels of unknown sides: the IMU is required


def test_other_scenarios_have_no_such_robots():
    with pytest.raises(BadUsage, match='--drive skid: --scenario town: required: one of indoor'):
        simulate(SimOptions(scenario='town', drive='skid'))
