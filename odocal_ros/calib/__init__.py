# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration methods, error budgets, verdicts, and the combination of legs."""
