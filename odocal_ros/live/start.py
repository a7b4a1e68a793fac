# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The commands calibrator, odometry, drive_pattern: start a node, or print what is missing."""

from functools import partial
from importlib import import_module
import sys


def _run(command: str, module: str) -> int:
    """Run a node; return its exit code, 2 without ROS 2."""
    try:
        main = import_module(module).main
    except ModuleNotFoundError as error:
        print(f'{command}: a live node needs ROS 2 (Python module {error.name} is missing). Run '
              "'source /opt/ros/jazzy/setup.bash', or 'pip install \".[ros]\"' in the source "
              'folder with Python 3.11 or 3.12 (Linux x86-64). Recorded bags need no ROS: '
              'odocal try BAG',
              file=sys.stderr)
        return 2
    code: int = main()
    return code


calibrator = partial(_run, 'calibrator', 'odocal_ros.live.node')
odometry = partial(_run, 'odometry', 'odocal_ros.live.odometry')
drive_pattern = partial(_run, 'drive_pattern', 'odocal_ros.live.drive_pattern')
