# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal paper: tables 1 to 4 of Shi et al. 2015, printed and computed values."""

import argparse

from odocal_reproductions.command import add_outputs, picture_of
from odocal_ros.offline.cli import print_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_outputs(parser, 'the track and the growth of each error over time')


def run(args: argparse.Namespace) -> int:
    """Compute, print, draw; return 0."""
    picture = picture_of(args)
    from odocal_reproductions.paper.tables import compute
    tables = compute()
    if picture is not None:
        from odocal_reproductions.paper.plot import draw
        draw(tables, picture)
    if args.json:
        import json
        print_text(json.dumps(tables.as_dict(), indent=2, allow_nan=False))
    else:
        from odocal_reproductions.paper.text import text_of
        print_text(text_of(tables), end='')
        if picture is not None:
            print_text(f'\n{picture}: the track and the growth of each error')
    return 0
