# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of a fleet: each bag is a task on Dask; then tables of vehicles, and a page."""

from odocal_ros.fleet.command import calibrate_bags

__all__ = ['calibrate_bags']
