# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start the calibrator and, with rviz:=true, RViz: includes calibrator.launch.xml."""
# ruff: noqa: I001  (takes the package launch for this folder)

from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

# a plain path, so that --show-args lists the arguments of the included file
INCLUDED = str(Path(__file__).with_name('calibrator.launch.xml'))


def generate_launch_description():
    """Return the nodes and arguments of the XML launch file."""
    return LaunchDescription([IncludeLaunchDescription(AnyLaunchDescriptionSource(INCLUDED))])
