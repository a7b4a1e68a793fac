# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The factors of the likelihood: rows of sensors and pseudo-observations (``factor.Factor``)."""
