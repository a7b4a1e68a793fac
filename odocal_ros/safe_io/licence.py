# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The licence header of the source files, an entry point for ament_copyright (no SPDX itself)."""

from typing import NamedTuple


class Licence(NamedTuple):
    """A licence in the form of ament_copyright; the braces are the copyright line."""

    name: str
    file_headers: list[str]
    license_files: list[str]
    contributing_files: list[str]


SPDX = Licence('Apache-2.0 by SPDX', ['{copyright}\nSPDX-License-Identifier: Apache-2.0'], [], [])
