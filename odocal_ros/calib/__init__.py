# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The methods, their error budgets, their verdict, legs combined."""
