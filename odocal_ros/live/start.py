# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The commands calibrator and odometry: start a node, or print the missing requirement."""

from importlib import import_module
import sys


def calibrator() -> int:
    """Run the node calibrator; 2 without ROS 2."""
    return _run('calibrator', 'odocal_ros.live.node')


def odometry() -> int:
    """Run the node odometry; 2 without ROS 2."""
    return _run('odometry', 'odocal_ros.live.odometry')


def _run(command: str, module: str) -> int:
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
