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
    comparison = compare(*args.files)
    if args.json:
        print_json(comparison.to_dict())
    else:
        print_text('\n'.join(_screen(comparison)))
    return OK if comparison.changed is False else REJECTED


def _screen(comparison: 'Comparison') -> list[str]:
    from odocal_ros.library.compare import label_of, shared_error_notes
    from odocal_ros.output.stored import estimate_text
    from odocal_ros.output.value_text import counted, table_lines
    stored = comparison.stored
    width = max(len(calibration.name) for calibration in stored)
    lines = [f'{number:>3}  {calibration.name:<{width}}  {calibration.created}  '
             f'{calibration.verdict.value}, {counted(len(calibration.legs), "leg")}'
             for number, calibration in enumerate(stored, 1)]
    for change in comparison.changes:
        rows: list[tuple[str, ...]] = [
            (f'{entry.index + 1:>2}', estimate_text(entry.estimate),
             _cell(change, entry.to_first, stored), _cell(change, entry.to_previous, stored))
            for entry in change.entries]
        rows.insert(0, ('', 'value', 'since the first', 'since the previous'))
        if len(stored) == 2:       # both are the same
            rows = [row[:3] for row in rows]
        lines += ['', label_of(change.parameter), *table_lines(rows, ' ')]
    return [*lines, '', *(f'note: {note}' for note in comparison.notes), *comparison.sentences,
            *shared_error_notes(comparison.changes, stored)]


def _cell(change: 'Change', difference: 'Difference | None', stored: 'tuple[Stored, ...]') -> str:
    from odocal_ros.library.compare import change_text
    if difference is None:
        return '-'
    sigmas = '' if difference.sigmas is None else f' ({difference.sigmas:+z.1f} sigma)'
    return change_text(change, difference, stored) + sigmas
