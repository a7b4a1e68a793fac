# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal compare: print changes between calibration.json files of one vehicle, in sigmas."""

import argparse
from typing import TYPE_CHECKING

from odocal_ros.offline.cli import print_json, print_text

if TYPE_CHECKING:
    from odocal_ros.library.compare import Change, Comparison, Difference
    from odocal_ros.output.stored import Stored


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'Show each value and its change since the first and since the previous calibration, in '
        'its unit and in sigmas. A change is significant beyond 3 sigma. Exit code 0: no '
        'significant change; 1: changed, or nothing to compare; 2: wrong use or an unreadable '
        'file.')
    parser.add_argument('files', nargs='+', metavar='CALIBRATION',
                        help='calibration.json or its folder, the oldest first; two or more')
    parser.add_argument('--json', action='store_true', help='print the changes as JSON')


def run(args: argparse.Namespace) -> int:
    from odocal_ros.library.compare import compare
    from odocal_ros.offline.cli import OK, REJECTED
    found = compare(*args.files)
    if args.json:
        print_json(found.to_dict())
    else:
        print_text('\n'.join(_screen(found)))
    return OK if found.changed is False else REJECTED


def _screen(found: 'Comparison') -> list[str]:
    from odocal_ros.library.compare import hints, label
    from odocal_ros.output.stored import estimate_text as value_text
    from odocal_ros.output.value_text import counted, table_lines
    stored = found.stored
    width = max(len(s.name) for s in stored)
    lines = [f'{i:>3}  {s.name:<{width}}  {s.created}  {s.verdict.value}, '
             f'{counted(len(s.legs), "leg")}' for i, s in enumerate(stored, 1)]
    for change in found.changes:
        rows: list[tuple[str, ...]] = [
            (f'{e.index + 1:>2}', value_text(e.estimate), _cell(change, e.to_first, stored),
             _cell(change, e.to_previous, stored)) for e in change.entries]
        rows.insert(0, ('', 'value', 'since the first', 'since the previous'))
        if len(stored) == 2:       # both are the same
            rows = [row[:3] for row in rows]
        lines += ['', label(change.parameter), *table_lines(rows, ' ')]
    return [*lines, '', *(f'note: {note}' for note in found.notes), *found.sentences,
            *hints(found.changes, stored)]


def _cell(change: 'Change', difference: 'Difference | None', stored: 'tuple[Stored, ...]') -> str:
    from odocal_ros.library.compare import amount
    if difference is None:
        return '-'
    sigmas = '' if difference.sigmas is None else f' ({difference.sigmas:+z.1f} sigma)'
    return amount(change, difference, stored) + sigmas
