# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a leg to its result, pure: prepare, align, reckon, methods, check, combination."""
