# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Feed faulty streams with known truth to ``odometry``, and hold what it publishes against the truth.

    python benchmarks/stream_faults.py [--streams 1000] [--seed 1] [--jobs 2] [--only N]

Each stream is a drive of two minutes with one to three faults at random places and of random sizes
(``test/apply/faulty_streams.py``). Printed: the streams in which a pose is off by more than five
of its sigmas, or not finite, each with its faults, and whether anything was said; and the worst of
all. A restart begins a new path: poses are judged against the first one after it. The pure core is
run.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
import sys

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test' / 'apply'))
from faulty_streams import SIGMAS, stream  # noqa: E402


def main():
    """Run streams and print those that are wrong."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--streams', type=int, default=1000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--jobs', type=int, default=1)
    parser.add_argument('--only', type=int)
    args = parser.parse_args()
    numbers = range(args.streams) if args.only is None else [args.only]
    with ProcessPoolExecutor(args.jobs) as pool:
        found = list(pool.map(partial(stream, args.seed), numbers, chunksize=10))
    wrong = [one for one in found if not one[2] <= SIGMAS]
    for number, faults, worst, what, restarts, said in wrong:
        print(f'{number}: {worst:.3g} sigma, {what}; {restarts} restarts, '
              f'{"said" if said else "SILENT"}: {"; ".join(faults)}')
    silent = sum(not one[5] for one in wrong)
    print(f'{len(found)} streams: {len(wrong)} with a pose beyond {SIGMAS:g} sigma, {silent} of '
          f'them silent; {sum(one[4] > 0 for one in found)} with a restart; median of the worst '
          f'{np.median([one[2] for one in found]):.2f}, the worst '
          f'{max(one[2] for one in found):.3g} sigma')


if __name__ == '__main__':
    main()
