# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Untrusted input (names, YAML, sizes), and files for other programs."""
