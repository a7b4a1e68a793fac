# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A straight drive with a known heading, and one through a town with its running estimates."""

from forecast_drives import drive_of, fit_updates, HEADING
import pytest

from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate


@pytest.fixture(scope='session')
def drive():
    return simulate(SimOptions(scenario='straight', duration=300.0, imu_rate=50.0, seed=3,
                               imu_grade='tactical', fix_noise='white', fix_sigma=0.5))


@pytest.fixture(scope='session')
def config(drive):
    return with_settings(Config(), {
        'imu.grade': 'tactical', 'gnss.correlation_time': 0.0, 'alignment.heading_source': 'fixed',
        'alignment.heading': drive.truth.heading, 'alignment.heading_sigma': HEADING})


@pytest.fixture(scope='session')
def exact():
    """Return settings of an IMU without scale and axis errors, as in the simulation."""
    return with_settings(Config(), {'imu.grade': 'industrial', 'method': 'smoother',
                                    'imu.accel_scale_sigma': 0.0, 'imu.misalignment_sigma': 0.0,
                                    'imu.gyro_by_force_sigma': 0.0})


@pytest.fixture(scope='session')
def town_drive():
    return drive_of()


@pytest.fixture(scope='session')
def updates(town_drive, exact):
    return fit_updates(town_drive, exact)
