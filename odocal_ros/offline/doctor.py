# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal doctor: print versions, installed packages and output folders, for bug reports."""

import argparse
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
import os
from pathlib import Path
import platform
import shutil
import subprocess
import sys

from odocal_ros import __version__
from odocal_ros.offline.cli import print_text

NEEDED = ('numpy', 'scipy', 'pyproj', 'PyYAML', 'matplotlib', 'jinja2', 'tqdm')
# package: what does not work without it
OPTIONAL = {'rosbags': 'rosbag1 files, message types of a bag, written bags',
            'rich': 'odocal watch', 'pandas': 'to_frame', 'pyarrow': 'Parquet'}
# no other environment variable is printed: it may be secret
SHOWN_VARIABLES = ('ROS_DISTRO', 'ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE',
                   'ROS_LOCALHOST_ONLY', 'ROS_HOME', 'ODOCAL_LIMITS')
MISSING = 'MISSING'
PROBE = ('import sys, rclpy\n'
         'from rclpy.utilities import get_rmw_implementation_identifier as rmw\n'
         'sys.stdout.write(f"{rclpy.__file__}\\n{rmw()}\\n")')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options: there are none."""


def run(args: argparse.Namespace) -> int:
    """Print the installation; return 0, or 1 if a required package is missing."""
    rows = [('odocal_ros', f'{__version__}, {Path(__file__).resolve().parents[1]}'),
            ('Python', f'{platform.python_version()}, {sys.executable}'),
            ('system', f'{platform.platform()}, {os.cpu_count()} cores')]
    rows += [(name, _version(name)) for name in NEEDED]
    rows += [(name, _version(name, f'not installed: no {use}')) for name, use in OPTIONAL.items()]
    rows += _ros()
    rows += [(name, os.environ[name]) for name in SHOWN_VARIABLES if name in os.environ]
    rows += [('results of a node',
              _folder_text(Path(os.environ.get('ROS_HOME') or '~/.ros') / 'odocal')),
             ('results of a replay', _folder_text(Path.cwd()))]
    width = max(len(name) for name, _ in rows)
    print_text('\n'.join(f'{name:<{width}}  {text}' for name, text in rows))
    missing = [name for name, text in rows if text == MISSING]
    print_text(f'missing: {", ".join(missing)}; reinstall odocal_ros (docs/install.md)' if missing
               else 'all required packages found')
    return 1 if missing else 0


def _version(name: str, missing_text: str = MISSING) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return missing_text


def _ros() -> list[tuple[str, str]]:
    """Return path of rclpy and name of the ROS middleware, or why the node cannot run."""
    if find_spec('rclpy') is None:
        return [('rclpy', 'none: the node cannot run here, bags can be replayed')]
    # in a separate process: a crash does not end this one
    process = subprocess.run([sys.executable, '-c', PROBE], capture_output=True, text=True)
    if process.returncode:
        return [('rclpy', f'BROKEN: {(process.stderr.strip().splitlines() or ["?"])[-1]}')]
    path, rmw = process.stdout.splitlines()
    return [('rclpy', path), ('rmw', rmw)]


def _folder_text(folder: Path) -> str:
    """Return a folder, whether it is writable, and its free space, as text."""
    folder = folder.expanduser()
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    free = shutil.disk_usage(existing).free / 1e9
    access = 'can be written' if os.access(existing, os.W_OK) else 'CANNOT BE WRITTEN'
    return f'{folder}, {access}, {free:.1f} GB free'
