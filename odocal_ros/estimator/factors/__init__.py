# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The factors of the likelihood: one file per sensor or prior (``factor.Factor``)."""
