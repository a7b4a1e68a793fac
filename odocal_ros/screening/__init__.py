# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From samples to inputs: what is usable, what is damaged, late, mirrored or turned."""
