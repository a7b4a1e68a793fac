# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Manoeuvres inserted in a planned drive: what they add, what they do not change."""

import numpy as np
import pytest

from odocal_ros.forecast import planned_drive

pytestmark = pytest.mark.core


def straight(rest=30.0):
    t = np.arange(0.0, 120.0 + 2 * rest + 0.05, 0.1)
    return planned_drive.drive_from_rates(t,
                                          np.interp(t, [rest, rest + 15, rest + 105, rest + 120],
                                                    [0.0, 15.0, 15.0, 0.0]), np.zeros_like(t))


def test_an_inserted_stop_adds_braking_and_a_standstill():
    drive = straight()
    changed = planned_drive.add_stop_and_start(drive)
    assert changed.duration - drive.duration == pytest.approx(10.0 + 5.0 + 10.0)    # 15 / 1.5
    assert changed.distance - drive.distance == pytest.approx(15.0**2 / 1.5, rel=1e-3)
    rests = changed.standstills(2.0)
    assert [b - a for a, b in rests] == pytest.approx([30.0, 5.0, 30.0], abs=0.11)
    assert rests[1][0] == pytest.approx(60.0 + 10.0, abs=0.2)      # in the middle of the path
    assert np.abs(np.diff(changed.speed) / np.diff(changed.t)).max() < 1.6
    assert np.ptp(changed.yaw) == 0.0


def test_turns_in_both_directions_return_to_the_initial_direction():
    drive = straight()
    changed = planned_drive.add_left_and_right_turns(drive)
    assert changed.yaw[-1] == pytest.approx(drive.yaw[-1])
    assert np.ptp(changed.yaw) == pytest.approx(np.pi / 2)
    assert changed.yaw.max() > drive.yaw[0] + 1.5           # first to the left
    turn = np.pi / 2 * 15.0 / 2.0           # 2 m/s^2 to the side at 15 m/s
    assert changed.duration - drive.duration == pytest.approx(2 * turn + 5.0)
    rate = np.diff(changed.yaw) / np.diff(changed.t)
    assert np.abs(rate * 15.0).max() == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_array_equal(changed.standstills(2.0)[0], drive.standstills(2.0)[0])


@pytest.mark.parametrize('rest', [0.0, 30.0])
def test_town_driving_comes_before_the_last_rest(rest):
    drive = straight(rest)
    if not rest:
        drive = drive.cut_at(100.0, 0.0001)      # ends in motion, but for the last row
    changed = planned_drive.add_town_driving(drive, 5)
    # 10 s up, 25 s at 12 m/s, 10 s down, each minute
    town = 5 * 12.0 * 35.0
    assert changed.distance - drive.distance == pytest.approx(town, rel=1e-3)
    assert changed.duration - drive.duration == pytest.approx(300.0)
    turned = changed.yaw - drive.yaw[0]
    # left, left, right, right, left
    assert turned.max() == pytest.approx(np.pi)
    assert turned[-1] == pytest.approx(np.pi / 2)
    assert changed.speed[-1] == 0.0


def test_town_driving_brakes_first_where_the_drive_ends_in_motion():
    t = np.arange(0.0, 60.0, 0.1)
    drive = planned_drive.drive_from_rates(t, np.full_like(t, 15.0), np.zeros_like(t))
    changed = planned_drive.add_town_driving(drive, 1)
    assert changed.duration - drive.duration == pytest.approx(10.0 + 60.0)
    assert np.abs(np.diff(changed.speed) / np.diff(changed.t)).max() < 1.6
    assert changed.speed[-1] == 0.0


def test_a_stop_is_inserted_in_a_drive_in_reverse_only():
    t = np.arange(0.0, 60.0, 0.1)
    drive = planned_drive.drive_from_rates(t, np.full_like(t, -3.0), np.zeros_like(t))
    changed = planned_drive.add_stop_and_start(drive)
    assert changed.speed.max() == 0.0
    assert changed.speed.min() == -3.0
    assert changed.duration - drive.duration == pytest.approx(2 * 2.0 + 5.0)
