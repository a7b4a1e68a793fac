# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What benchmarks share: arguments, and rows that outlive an interruption, a line of JSON each."""

import argparse
from concurrent.futures import ProcessPoolExecutor
import json
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / folder) for folder in (
    '.', 'test', 'test/apply', 'test/calib', 'test/fuzz', 'test/live')]


def parsed(doc, **known):
    """
    Return the arguments of the command line.

    known : name to default, (default, help), type of one without a default, (type, help), or what
    ``add_argument`` takes.
    """
    parser = argparse.ArgumentParser(description=doc,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, one in known.items():
        parser.add_argument(f'--{name.replace("_", "-")}', **_argument(one))
    return parser.parse_args()


def _argument(one):
    if isinstance(one, dict):
        return one
    default, about = one if isinstance(one, tuple) else (one, None)
    if isinstance(default, bool):
        return {'action': 'store_true', 'help': about}
    if isinstance(default, type):
        return {'type': default, 'help': about}
    return {'type': type(default), 'default': default, 'help': about}


def configured(drive):
    """Return the settings that the vehicle's operator has."""
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.sim.truth import operator_settings
    return with_settings(Config(), {f'{group}.{key}': tuple(v) if isinstance(v, list) else v
                                    for group, keys in operator_settings(drive).items()
                                    for key, v in keys.items()})


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


def run_missing(run, seeds, have, file, jobs, *more, block=1):
    """
    Return the rows of all seeds; those that are missing are run, and written as they come.

    run : called with a seed and ``more``, in ``jobs`` processes.   have : rows by seed.   block :
    runs of a process before it reports.
    """
    missing, have = [seed for seed in seeds if seed not in have], dict(have)
    with ProcessPoolExecutor(jobs) as pool, file.open('a') as out:
        done = pool.map(run, missing, *([one] * len(missing) for one in more), chunksize=block)
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
    args = parsed(doc, drives=(40, 'of each name'), jobs=(1, 'processes'), file=Path(file),
                  only={'choices': names, 'action': 'append', 'default': [], 'metavar': 'NAME'})
    first, each = seeds
    # by turns, so that what is there after an interruption is of all names
    wanted = [first + each * names.index(name) + k for k in range(args.drives)
              for name in args.only or names]
    table(run_missing(run, wanted, read_rows(args.file), args.file, args.jobs))
