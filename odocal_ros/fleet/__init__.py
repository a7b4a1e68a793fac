# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Many vehicles: each bag is a Dask task with the pipeline of replay; then vehicles and a page."""


from odocal_ros.fleet.command import calibrate_bags

__all__ = ['calibrate_bags']
