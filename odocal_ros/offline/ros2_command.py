# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The command ``ros2 odocal``: the command ``odocal`` as an extension of ros2cli.

ros2cli creates an instance of the class in the entry point and calls its two methods. The class is
not derived from the base class of ros2cli, so this module needs no ROS.
"""

import argparse

from odocal_ros.offline import cli


class OdocalCommand:
    """Calibrate a vehicle's odometer against IMU and GNSS, from recorded bags."""

    NAME = 'odocal'
    EXTENSION_POINT_VERSION = '0.1'

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Declare that all arguments after the command belong to odocal."""
        parser.add_argument('argv', nargs=argparse.REMAINDER, metavar='COMMAND ...',
                            help=f'a command of odocal and its options; {cli_name} COMMAND --help')
        parser.epilog = 'commands:\n' + '\n'.join(
            f'  {name:<10}{about}' for name, (_, about) in cli.COMMANDS.items())

    def main(self, *, parser: argparse.ArgumentParser, args: argparse.Namespace) -> int:
        """Run the command; return its exit code."""
        return cli.main(args.argv)
