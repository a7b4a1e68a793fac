# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shi et al. 2015: the tables, the drive, the error model."""
