# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Safe input and output: limits for untrusted files, safe text, atomic writing."""
