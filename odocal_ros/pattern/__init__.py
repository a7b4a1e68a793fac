# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Patterns that a robot drives for a calibration: routes, and the commands that follow them."""
