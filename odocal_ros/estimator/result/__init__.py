# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a fit to a result: estimates, reasons, error budget, single wheels, details for files."""
