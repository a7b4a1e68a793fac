# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples, the legs made of them, and rows that outgrow memory: arrays, and what was sent."""
