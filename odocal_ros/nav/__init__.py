# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Earth, rotations, strapdown, odometer, dead reckoning, standstills."""
