# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``python -m odocal_ros``: the command ``odocal``."""

import sys

from odocal_ros.offline.cli import main

sys.exit(main())
