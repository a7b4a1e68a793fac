# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecast of a leg during the drive, from few of its rows; without ROS."""
