# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rows of a benchmark that continues after an interruption: one JSON object per line."""

import argparse
from concurrent.futures import ProcessPoolExecutor
import json
from pathlib import Path
import sys


def read_rows(path) -> dict[int, dict]:
    """Return rows by seed; a last line cut short by an interruption is done again."""
    rows = {}
    if path.exists():
        text = path.read_text()
        if text and not text.endswith('\n'):
            text = text[:text.rfind('\n') + 1]
            path.write_text(text)
        rows = {row['seed']: row for row in map(json.loads, text.splitlines())}
    return rows


def run_missing(run, seeds, have, file, jobs, *more):
    """
    Return the rows of all seeds; those that are missing are run, and written as they come.

    run : called with a seed and ``more``, in ``jobs`` processes.   have : rows by seed.
    """
    missing, have = [seed for seed in seeds if seed not in have], dict(have)
    with ProcessPoolExecutor(jobs) as pool, file.open('a') as out:
        done = pool.map(run, missing, *([one] * len(missing) for one in more))
        for n, row in enumerate(done, 1):
            out.write(json.dumps(row) + '\n')
            out.flush()
            have[row['seed']] = row
            print(f'\r{n} of {len(missing)}', end='', file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return [have[seed] for seed in seeds]


def run_by_name(doc, run, names, seeds, table, file):
    """
    Run drives of each name by the options of the command line, and print their table.

    run : returns the row of a seed.   seeds : the first, and how many each name has.   table :
    prints rows.   file : default file of the rows.
    """
    parser = argparse.ArgumentParser(description=doc.split('\n\n')[0])
    parser.add_argument('--drives', type=int, default=40, help='of each name')
    parser.add_argument('--only', choices=names, action='append', default=[], metavar='NAME')
    parser.add_argument('--jobs', type=int, default=1, help='processes')
    parser.add_argument('--file', type=Path, default=Path(file))
    args = parser.parse_args()
    first, each = seeds
    # by turns, so that what is there after an interruption is of all names
    wanted = [first + each * names.index(name) + k for k in range(args.drives)
              for name in args.only or names]
    table(run_missing(run, wanted, read_rows(args.file), args.file, args.jobs))
