# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags and changes of a simulated fleet agree with its truth."""

from collections import Counter

from drives import drive
import numpy as np
import pytest

from odocal_ros.sim.fleet import drive_options, fleet_of, MODELS, WALK, with_broken_counter
from odocal_ros.sim.scenarios import SimOptions


def test_sixty_vehicles_have_six_tyres_three_imus_and_two_counters_changed():
    fleet = fleet_of(60, 10, seed=3)
    changes = [change for vehicle in fleet for change in vehicle.changes]
    assert Counter(change.value for change in changes) == {
        'scale_factor': 6, 'yaw_mounting_angle': 3, 'counter': 2}
    assert all(1 <= change.bag <= 8 for change in changes)       # a bag before it, one after
    assert max(len(vehicle.changes) for vehicle in fleet) == 1
    assert {vehicle.model for vehicle in fleet} == set(MODELS)
    assert len({vehicle.name for vehicle in fleet}) == 60


def test_values_change_by_the_stated_steps_and_the_scale_random_walk():
    steps = []
    for vehicle in fleet_of(300, 10, seed=4):
        jump, turn = np.diff(np.log(vehicle.scale)), np.diff(vehicle.yaw)
        for change in vehicle.changes:
            if change.value == 'scale_factor':
                jump[change.bag - 1] -= np.log1p(change.size)
            elif change.value == 'yaw_mounting_angle':
                turn[change.bag - 1] -= change.size
        steps.append(jump)
        assert turn == pytest.approx(np.zeros(9), abs=1e-15)
    # 2700 draws: their rms is known to 1.4 %
    assert np.sqrt(np.mean(np.square(steps))) == pytest.approx(WALK * 7**0.5, rel=0.05)


def test_a_drive_has_the_values_of_its_vehicle_or_a_broken_counter():
    vehicle = fleet_of(1, 2, seed=5)[0]
    options = drive_options(vehicle, 0, 1, SimOptions(scenario='straight', duration=200.0))
    assert (options.scale, options.yaw) == (vehicle.scale[1], vehicle.yaw[1])
    made = drive(scenario='straight', duration=200.0)
    value = with_broken_counter(made).odometer.value
    k = len(value) // 3
    np.testing.assert_array_equal(value[:k], made.odometer.value[:k])
    assert np.ptp(value[k:]) == 0 < np.ptp(made.odometer.value[k:])
