# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect: print the content of a bag, its problems and the replay command (or JSON)."""

import argparse
from pathlib import Path

from odocal_ros.offline import replay
from odocal_ros.offline.cli import print_json, print_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', metavar='BAG', help='bag folder or file')
    parser.add_argument('--json', action='store_true', help='print everything as JSON')
    replay.add_input_arguments(parser, 'the most likely one')


def run(args: argparse.Namespace) -> int:
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.offline.inspection import inspect
    from odocal_ros.offline.inspection_text import text
    from odocal_ros.settings.config import Config, with_settings
    config = with_settings(Config(), replay.settings_from_arguments(args))
    with open_bag(Path(args.bag)) as bag:
        content = inspect(bag, args.bag, config, replay.topics_from_arguments(args))
    if args.json:
        print_json(content)
    else:
        print_text(text(content))
    return 0
