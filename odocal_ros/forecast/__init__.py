# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecast of the sigmas of a leg: of a planned drive, or of one that is recorded; without ROS."""
