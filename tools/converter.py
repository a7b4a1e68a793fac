# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command line of the converters of public recordings."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import sys

from odocal_ros.errors import OdocalError


def run(name: str, source: str, convert: Callable[[Path, Path, bool], Path],
        argv: Sequence[str] | None = None) -> int:
    """
    Convert a recording and print the bag; return 0, 2 for unusable input.

    name : of the converter.   source : the recording, for the help.   convert : recording, folder,
    whether to replace a bag that is there, to the bag.
    """
    parser = argparse.ArgumentParser(description=f'make a bag of {source}')
    parser.add_argument('recording', type=Path, help=source)
    parser.add_argument('--out', type=Path, required=True, metavar='FOLDER')
    parser.add_argument('--force', action='store_true', help='replace a bag that is there')
    args = parser.parse_args(argv)
    try:
        print(convert(args.recording, args.out, args.force))
    except (OdocalError, OSError) as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    return 0
