# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tables and error model of Shi et al. 2015, computed."""
