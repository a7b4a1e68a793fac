# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Fuzz the node over the wire: hostile messages and services in any order, any number of rounds.

    python benchmarks/wire.py [--rounds 20] [--seed 1] [--speed 20]

A round is a leg of a simulated drive over real DDS, some of its messages odd (values, stamps,
sizes, frames), with services called and parameters set between. The node has to live and to
answer, to say nothing negative or internal, and what it accepts has to be true.
"""

from pathlib import Path
import sys
import tempfile
import time

from harness import parsed


def main() -> int:
    """Run rounds; return 1 if anything was wrong."""
    from kills import drive
    from wire import Wire
    args = parsed(__doc__, rounds=20, seed=1, speed=(20.0, 'times real time'))
    bad, begin = 0, time.monotonic()
    with tempfile.TemporaryDirectory(prefix='odocal_wire_') as folder:
        wire = Wire(drive(), Path(folder), args.speed)
        try:
            for seed in range(args.seed, args.seed + args.rounds):
                seen = wire.round(seed)
                bad += bool(seen.wrong)
                print(seen, flush=True)
        finally:
            code = wire.close()
    print(f'{args.rounds} rounds in {time.monotonic() - begin:.0f} s, {bad} bad, exit {code}')
    return int(bad > 0 or code != 0)


if __name__ == '__main__':
    sys.exit(main())
