# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The option --export: names separated by commas, and given again."""

import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline.cli import main
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow


def test_an_option_given_again_adds_its_files(tmp_path):
    drive = simulate(SimOptions(scenario='straight', duration=200.0, imu_rate=50.0,
                                odometer_rate=20.0))
    bag = write_bag(tmp_path / 'drive', drive_topics(drive))
    main(['replay', str(bag), '--output', str(tmp_path / 'out'), '--quiet', '--set',
          'output.formats=[params]', '--export',
          'trajectory.tum,track.kml', '--export', 'trajectory.csv'])
    for name in ('trajectory.tum', 'track.kml', 'trajectory.csv'):
        assert (tmp_path / 'out' / name).is_file(), name
