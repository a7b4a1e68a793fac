# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The search of patent CN104359492A: orthogonal arrays, response surfaces, its criteria."""
