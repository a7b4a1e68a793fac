# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The door to the outside: names, YAML and sizes from others, files that others read."""
