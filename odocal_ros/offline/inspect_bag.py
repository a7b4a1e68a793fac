# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect: what a bag holds, what is odd about it, how to replay it, what it lacks."""

import argparse
from pathlib import Path

from odocal_ros.offline.say import say

SLOTS = ('imu', 'odometer', 'odometer_right', 'fix', 'heading', 'fix_velocity')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add('bag', metavar='BAG', help='bag folder or file')
    add('--json', action='store_true', help='print everything as JSON')
    add('--config', metavar='FILE', help='ROS parameter file, the same YAML as for the node')
    add('--set', action='append', default=[], metavar='KEY=VALUE', dest='settings',
        help='any setting by its parameter name; repeatable')
    for slot in SLOTS:
        add(f'--{slot.replace("_", "-")}-topic', metavar='TOPIC', dest=f'{slot}_topic',
            help=f'use this topic as {slot.replace("_", " ")}')


def run(args: argparse.Namespace) -> int:
    """Inspect a bag and print what was found."""
    import json

    from odocal_ros.bagio.read import open_bag
    from odocal_ros.offline.inspection import inspect
    from odocal_ros.offline.inspection_text import text
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.settings.config_file import parse_set, read_config_file
    config = Config()
    if args.config:
        config = with_settings(config, read_config_file(Path(args.config)))
    config = with_settings(config, dict(parse_set(setting) for setting in args.settings))
    overrides = {slot: topic for slot in SLOTS if (topic := getattr(args, f'{slot}_topic'))}
    with open_bag(Path(args.bag)) as bag:
        found = inspect(bag, args.bag, config, overrides)
    say(json.dumps(found, indent=2, allow_nan=False) if args.json else text(found))
    return 0
