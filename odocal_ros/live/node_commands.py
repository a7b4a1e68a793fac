# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Console scripts of the nodes and ``odocal watch``, with an error for a missing package."""

from argparse import ArgumentParser, Namespace
from functools import partial
from importlib import import_module
import sys

from odocal_ros.errors import BadUsage

WAIT_S = 10.0      # judgement: s in which a node sends a status, or its latched one arrives
NO_STATUS_REMEDY = 'start the node, or check its name (ros2 node list) and ROS_DOMAIN_ID'
INSTALL_REMEDIES = {'rich': 'pip install rich (or apt install python3-rich)',
         'rclpy': "source ROS 2 Jazzy, or install odocal_ros with the extra 'ros'"}


def _run(command: str, module: str) -> int:
    try:
        main = import_module(module).main
    except ModuleNotFoundError as error:
        print(f'{command}: a live node needs ROS 2 (Python module {error.name} is missing). Run '
              "'source /opt/ros/jazzy/setup.bash', or 'pip install \".[ros]\"' in the source "
              'folder with Python 3.11 to 3.13 (Linux x86-64). Recorded bags need no ROS: '
              'odocal try BAG',
              file=sys.stderr)
        return 2
    code: int = main()
    return code


calibrator = partial(_run, 'calibrator', 'odocal_ros.live.node')
odometry = partial(_run, 'odometry', 'odocal_ros.live.odometry')
drive_pattern = partial(_run, 'drive_pattern', 'odocal_ros.live.drive_pattern')


def add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('node', nargs='?', default='/calibrator',
                        help='full name of the node (default: /calibrator)')
    parser.add_argument('--once', action='store_true',
                        help=f'print the first status and exit; 2 if none arrives in {WAIT_S:g} s')


def run(args: Namespace) -> int:
    """Show the panel until Ctrl-C."""
    try:
        from rich import print as print_panel
        from rich.live import Live
        from rich.panel import Panel

        from odocal_ros.live.watch import panel, StatusListener
    except ModuleNotFoundError as error:
        name = (error.name or '').partition('.')[0]
        raise BadUsage(f'odocal watch needs the package {name}: '
                       f'{INSTALL_REMEDIES.get(name, INSTALL_REMEDIES["rclpy"])}') from None
    if args.once:
        with StatusListener(args.node, WAIT_S) as listener:
            for level, status, hint in listener:
                print_panel(panel(level, args.node, status, hint))
                return 0
        raise BadUsage(f'no status on {args.node}/status for {WAIT_S:g} s: {NO_STATUS_REMEDY}')
    waiting = Panel(f'no status on {args.node}/status yet: {NO_STATUS_REMEDY}', title=args.node)
    with StatusListener(args.node) as listener, Live(waiting, auto_refresh=False) as shown:
        for level, status, hint in listener:
            shown.update(panel(level, args.node, status, hint), refresh=True)
    return 0
