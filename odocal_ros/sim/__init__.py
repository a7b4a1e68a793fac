# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drives with known truth: roads, vehicles, sensors and their errors."""
