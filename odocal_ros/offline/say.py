# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What commands print: the one door to the terminal, which names from outside must not steer."""

import sys

from odocal_ros.outside.names import brief_line, for_terminal


def say(text: str, end: str = '\n') -> None:
    """Print lines on stdout."""
    print(for_terminal(text), end=end)


def warn(text: str) -> None:
    """Print one line on stderr."""
    print(brief_line(text), file=sys.stderr)
