# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One simulated drive, as a bag, and its calibration: for all tests of the library."""

import pytest

from odocal_ros import calibrate_bag, simulate


@pytest.fixture(scope='session')
def town(tmp_path_factory):
    """Return a drive through a town, and its bag with truth and settings beside it."""
    bag = tmp_path_factory.mktemp('library') / 'town'
    return simulate('town', bag, duration=240.0, imu_rate=50.0, odometer_rate=20.0), bag


@pytest.fixture(scope='session')
def calibration(town):
    return calibrate_bag(town[1], config=town[1].parent / 'calibrator.yaml')
