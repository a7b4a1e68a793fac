# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CN104359492A: its embodiment with the search of odocal_ros."""
