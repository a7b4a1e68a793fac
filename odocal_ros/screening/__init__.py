# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Screening of samples: selection of usable rows, and detection of sensor faults."""
