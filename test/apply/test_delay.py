# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The delay of the IMU relative to the odometer, found while driving and reported."""

import faulty_streams
import numpy as np
import pytest

from odocal_ros.apply.delay import DelaySearch, LEAST_DELAY_ROWS
from odocal_ros.apply.errors import GRAVITY
from odocal_ros.apply.odometry import Odometry
from odocal_ros.apply.vehicle import vehicle_of
from odocal_ros.settings.config import with_settings
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import simulate

FORWARD = (1.0, 0.0, 0.0)
REPORT = 'relative to the odometer'


def searched(late, bias=0.1, seconds=200):
    """Take seconds of a speed whose acceleration is a cosine of 9 s; the force is late."""
    notes = []
    search = DelaySearch(0.0, 0.01, notes)

    def speed(t):
        return 10.0 + 2.0 * np.sin(2 * np.pi * t / 9.0)

    for t in np.arange(1.0, seconds):
        change = [speed(t) - speed(t - 1), 0.0, 0.0]
        force = speed(t - late) - speed(t - 1 - late) + bias
        search.take(FORWARD, np.array(change), (force, 0.0, GRAVITY), 1.0)
    return search, notes


@pytest.mark.parametrize('late', [0.1, -0.2])
def test_a_delay_is_found_beside_a_bias(late):
    """
    Of a sine of w the slope is off by w / sin(w), of which CHANGE_SMOOTHED is taken off.

    w = 2 pi / 9 a second: 1.09 for 1.2; to first order in w late.
    """
    search, notes = searched(late)
    w = 2 * np.pi / 9.0
    expected = late * w / np.sin(w) / 1.2
    found = float(notes[-1].split('are ')[1].split(' s')[0])
    assert found == pytest.approx(abs(expected), abs=0.01)
    assert ('late' if late > 0 else 'early') in notes[-1]
    assert search.sigma_s >= abs(expected) - 0.01


def test_without_a_delay_nothing_is_reported():
    search, notes = searched(0.0)
    assert not notes
    assert search.sigma_s == 0.01


def test_a_minute_is_needed_and_unusable_seconds_do_not_count():
    assert not searched(0.2, seconds=LEAST_DELAY_ROWS)[1]
    search = DelaySearch(0.0, 0.01, [])
    assert not any(search.take(FORWARD, None, (0.0, 0.0, GRAVITY), 1.0) for _ in range(500))


@pytest.mark.parametrize('late', [0.0, 0.15])
def test_late_stamps_of_a_drive_are_reported(late):
    drive = simulate(SimOptions(scenario='town', duration=240.0, seed=5, imu_rate=100.0,
                                odometer_rate=20.0, imu_grade='industrial'))
    config = with_settings(ApplyConfig(), {'imu.grade': 'industrial', 'publish.rate': 5.0})
    topics = faulty_streams.columns_of(drive)
    for column in ('stamp', 'arrival'):
        topics['imu'][column] = topics['imu'][column] + round(late * 1e9)
    vehicle = vehicle_of(faulty_streams.calibration(drive.truth, np.random.default_rng(5)), config)
    _, said = faulty_streams.run(drive, Odometry(vehicle, config), topics)
    reports = [text for text in said if REPORT in text]
    if late:
        assert float(reports[-1].split('are ')[1].split(' s')[0]) == pytest.approx(late, abs=0.04)
    else:
        assert not reports
