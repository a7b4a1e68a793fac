# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From recordings, options and figures to answers: for the commands, and for other programs."""
