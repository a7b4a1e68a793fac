# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal paper: tables 1 to 4 of Shi et al. 2015, computed beside printed."""

import argparse
from pathlib import Path

from odocal_ros.offline.say import say
from odocal_ros.output.pictures import check_picture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument('--json', action='store_true', help='print one JSON object instead')
    parser.add_argument('--plot', metavar='FILE', help='draw the track and the growth of each '
                        'error over time: .png, .svg or .pdf')


def run(args: argparse.Namespace) -> int:
    """Compute, print, draw; return 0."""
    picture = None if args.plot is None else Path(args.plot)
    if picture is not None:
        check_picture(picture)
    from odocal_ros.paper.tables import compute
    tables = compute()
    if picture is not None:
        from odocal_ros.output.paper_plot import draw
        draw(tables, picture)
    if args.json:
        import json
        say(json.dumps(tables.as_dict(), indent=2, allow_nan=False))
    else:
        from odocal_ros.paper.text import text_of
        say(text_of(tables), end='')
        if picture is not None:
            say(f'\n{picture}: the track and the growth of each error')
    return 0
