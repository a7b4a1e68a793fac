# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Without the package rosbags: bags of standard types are read, for the rest a line says so."""

import subprocess
import sys

from drives import drive
import pytest

from odocal_ros.bagio.encode import counter, fix, imu
from odocal_ros.bagio.write import write_bag

pytestmark = pytest.mark.slow
PROGRAM = ("import sys; sys.modules['rosbags'] = None\n"
           'from odocal_ros.offline.cli import main\n'
           'sys.exit(main(sys.argv[1:]))')


def odocal(folder, *words):
    """Run the command in a process that cannot import rosbags."""
    return subprocess.run([sys.executable, '-c', PROGRAM, *words], capture_output=True, text=True,
                          cwd=folder)


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_bag_of_standard_types_is_calibrated(tmp_path, storage):
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    write_bag(tmp_path / 'drive', [imu('/imu/data', made.imu), fix('/fix', made.fix),
                                   counter('/odometer', made.odometer)], storage=storage)
    done = odocal(tmp_path, 'replay', 'drive', '--set', 'method=two_point', '--quiet')
    assert done.returncode in (0, 1), done.stderr
    assert (tmp_path / 'odocal_drive' / 'calibration.json').exists()


def test_what_needs_it_says_so(tmp_path):
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk')
    write_bag(tmp_path / 'drive.bag', [imu('/imu/data', made.imu)], storage='rosbag1')
    for words in (['inspect', 'drive.bag'], [
            'simulate', '--scenario', 'straight', '--out', 'new']):
        done = odocal(tmp_path, *words)
        assert done.returncode == 2, done.stderr
        assert 'needs the Python package rosbags, which is not installed: pip install rosbags' in (
            done.stderr)
        assert done.stderr.count('\n') == 1
