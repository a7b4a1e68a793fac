# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Data from outside (names, YAML, sizes), and files for others."""
