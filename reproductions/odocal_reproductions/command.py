# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The options --json and --plot, which both commands have."""

import argparse
from pathlib import Path

from odocal_ros.errors import BadUsage


def add_outputs(parser: argparse.ArgumentParser, picture: str) -> None:
    """Declare --json and --plot; picture: what it shows."""
    parser.add_argument('--json', action='store_true', help='print JSON instead of text')
    parser.add_argument('--plot', metavar='FILE', help=f'draw {picture}: .png, .svg or .pdf')


def picture_of(args: argparse.Namespace) -> Path | None:
    """Return the file to draw into, None without --plot; check that it can be drawn."""
    if args.plot is None:
        return None
    from odocal_ros.output.plot_style import PICTURES  # it imports numpy: not for help
    path = Path(args.plot)
    if path.suffix.lower() not in PICTURES:
        raise BadUsage(f'--plot {path}: required: a name that ends in {", ".join(PICTURES)}')
    if not path.parent.is_dir():
        raise BadUsage(f'--plot {path}: no folder {path.parent}; create it first')
    if path.is_dir():
        raise BadUsage(f'--plot {path}: is a folder; required: a file')
    return path
