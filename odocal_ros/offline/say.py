"""What commands print: the one door to the terminal, which names from outside must not steer."""

import sys

from odocal_ros.outside.names import for_terminal, one_line


def say(text: str, end: str = '\n') -> None:
    """Print lines on stdout."""
    print(for_terminal(text), end=end)


def warn(text: str) -> None:
    """Print one line on stderr."""
    print(one_line(text), file=sys.stderr)
