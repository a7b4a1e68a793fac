# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags read and written, whole or damaged: the only place of rosbags."""
