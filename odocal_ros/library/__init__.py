# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results from recordings, options and figures, for the commands and for other programs."""
