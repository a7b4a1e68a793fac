# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of a leg, without side effects: prepare, align, reckon, methods, check, combine."""
