# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``odocal watch``: the status of a running node as a panel in the terminal."""

from argparse import ArgumentParser, Namespace

from odocal_ros.errors import BadUsage

NEEDS = {'rich': 'pip install rich (or apt install python3-rich)',
         'rclpy': "source ROS 2 Jazzy, or install odocal_ros with the extra 'ros'"}


def add_arguments(parser: ArgumentParser) -> None:
    """Declare what the command takes."""
    parser.add_argument('node', nargs='?', default='/calibrator',
                        help='full name of the node (default: /calibrator)')
    parser.add_argument('--once', action='store_true',
                        help='print the first status and exit')


def run(args: Namespace) -> int:
    """Show the panel until Ctrl-C."""
    try:
        from rich.live import Live

        from odocal_ros.live.panel import panel
        from odocal_ros.live.status_listener import StatusListener
    except ModuleNotFoundError as error:
        name = (error.name or '').partition('.')[0]
        raise BadUsage(f'odocal watch needs the package {name}: '
                       f'{NEEDS.get(name, NEEDS["rclpy"])}') from None
    waiting = panel(b'\x03', args.node, {'state': f'no status on {args.node}/status yet'},
                    'start the node, or check its name (ros2 node list) and ROS_DOMAIN_ID')
    with StatusListener(args.node) as listener, Live(waiting, auto_refresh=False) as shown:
        for level, status, hint in listener:
            shown.update(panel(level, args.node, status, hint), refresh=True)
            if args.once:
                break
    return 0
