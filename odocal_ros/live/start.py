# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The commands calibrator, odometry, drive_pattern: start a node, or print what is missing."""

from importlib import import_module
import sys


def calibrator() -> int:
    """Run the node calibrator; 2 without ROS 2."""
    return _run('calibrator', 'odocal_ros.live.node')


def odometry() -> int:
    """Run the node odometry; 2 without ROS 2."""
    return _run('odometry', 'odocal_ros.live.odometry')


def drive_pattern() -> int:
    """Run the node drive_pattern; 2 without ROS 2."""
    return _run('drive_pattern', 'odocal_ros.live.drive_pattern')


def _run(command: str, module: str) -> int:
    try:
        main = import_module(module).main
    except ModuleNotFoundError as error:
        print(f'{command}: a live node needs ROS 2 (Python module {error.name} is missing). Run '
              "'source /opt/ros/jazzy/setup.bash', or 'pip install \".[ros]\"' in the source "
              'folder with Python 3.11 to 3.13 (Linux x86-64). Recorded bags need no ROS: '
              'odocal try BAG',
              file=sys.stderr)
        return 2
    code: int = main()
    return code
