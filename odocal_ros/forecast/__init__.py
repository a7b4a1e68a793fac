# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecast of the sigmas of a leg, for a planned or a recorded drive; without ROS."""
