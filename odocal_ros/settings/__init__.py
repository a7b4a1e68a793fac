# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What may be set, its limits and defaults; IMU grades."""
