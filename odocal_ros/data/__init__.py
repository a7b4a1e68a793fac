# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples, legs, and storage of rows that do not fit into memory."""
