# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading (also of damaged bags) and writing of bags; only this package imports rosbags."""
