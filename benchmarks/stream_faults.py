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

from concurrent.futures import ProcessPoolExecutor
from functools import partial

from harness import parsed
import numpy as np


def main():
    """Run streams and print those that are wrong."""
    from faulty_streams import SIGMAS, stream
    args = parsed(__doc__, streams=1000, seed=1, jobs=1, only=int)
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
