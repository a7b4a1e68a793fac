# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The licence header of the source files, an entry point for ament_copyright (no SPDX itself)."""

from types import SimpleNamespace

# the braces are the copyright line
SPDX = SimpleNamespace(
    name='Apache-2.0 by SPDX', license_files=[], contributing_files=[],
    file_headers=['{copyright}\nSPDX-License-Identifier: Apache-2.0'])
