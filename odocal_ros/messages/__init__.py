# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From bytes to samples: CDR, message types, what of a message is the counter."""
