# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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
    """Return the calibration of that drive, by the settings beside its bag."""
    return calibrate_bag(town[1], config=town[1].parent / 'calibrator.yaml')
