# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Fuzz the commands that read bags: any number of cases, seeded, to be gone on with.

    python benchmarks/fuzz.py --cases 1000 [--seed 1] [--from 0] [--jobs 2] [--only N] [--log FILE]

A case is a clean bag, a mutation by its structure (or odd options), and one command. Every outcome
is exit 0, 1 or 2 with one sentence, in bounded time and memory, no file outside of the output
folder, and an accepted value within five sigma of the truth. What is not is printed, with its
number. With --log a line is written for each case, and the cases in the file are not run again.
"""

import argparse
from collections import Counter
from contextlib import closing
from functools import partial
from itertools import chain
import json
import multiprocessing
import os
from pathlib import Path
import sys
import tempfile
import time

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test' / 'fuzz'))

TOGETHER = 20       # cases in one process


def main() -> int:
    """Run cases; return how many left-overs there are, 1 at most."""
    import cases
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--cases', type=int, default=1000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--from', type=int, default=0, dest='first')
    parser.add_argument('--only', type=int, help='run this case and print what it said')
    parser.add_argument('--log', type=Path, help='a line of JSON for each case; gone on with')
    parser.add_argument('--jobs', type=int, default=1, help='cases at a time')
    parser.add_argument('--seconds', type=float, default=float('inf'), help='stop after these')
    args = parser.parse_args()
    known = {}
    if args.log and args.log.exists():
        lines = (json.loads(line) for line in args.log.read_text().splitlines())
        known = {line['number']: line for line in lines if line['seed'] == args.seed}
    numbers = [args.only] if args.only is not None else [
        n for n in range(args.first, args.first + args.cases) if n not in known]
    begin, codes, left = time.monotonic(), Counter(), 0
    memory = '/dev/shm' if os.access('/dev/shm', os.W_OK) else None     # no disk is waited for
    with tempfile.TemporaryDirectory(prefix='odocal_fuzz_', dir=memory) as folder:
        run = partial(cases.run, args.seed, cases.warm_up(cases.bases(Path(folder) / 'clean')),
                      Path(folder))
        with closing(outcomes(run, numbers, args.jobs)) as ran:
            for outcome in ran:
                codes[outcome.code] += 1
                left += bool(outcome.wrong)
                if outcome.wrong or args.only is not None:
                    print(f'case {outcome.number} ({outcome.what}, exit {outcome.code}, '
                          f'{outcome.seconds:.1f} s): {outcome.wrong}\n    {outcome.said}',
                          flush=True)
                if args.log:
                    with args.log.open('a') as file:
                        file.write(json.dumps({'seed': args.seed, **vars(outcome)}) + '\n')
                if time.monotonic() - begin > args.seconds:
                    break
    before = Counter(line['code'] for line in known.values())
    print(f'{codes.total()} cases in {time.monotonic() - begin:.0f} s, {left} left over; exits '
          f'{dict(codes)}' + (f'; {before.total()} in the log before, exits {dict(before)}, '
                              f'{sum(bool(line["wrong"]) for line in known.values())} left over'
                              if known else ''))
    return int(left > 0)


def outcomes(run, numbers, jobs):
    """Yield the outcomes of cases, some at a time."""
    batches = [numbers[k:k + TOGETHER] for k in range(0, len(numbers), TOGETHER)]
    if jobs == 1:
        yield from chain.from_iterable(map(run, batches))
        return
    with multiprocessing.get_context('fork').Pool(jobs) as pool:
        yield from chain.from_iterable(pool.imap_unordered(run, batches))


if __name__ == '__main__':
    sys.exit(main())
