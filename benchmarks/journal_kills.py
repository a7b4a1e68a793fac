# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What kill -9 costs: the node is killed at random moments of a leg and its journal replayed.

    python benchmarks/journal_kills.py [--kills 50] [--seed 20260601] [--longest 9] [--stage stop]

Every kill is a new node process that receives a simulated drive over DDS at ten times real time.
Lost is the wall time from the newest IMU message in the journal to the kill; the replay must find
the leg by its start mark. With ``--stage stop`` or ``save`` it is killed after ~/stop_leg or
~/save instead, and its result folders are looked at: whole or none, and none wrong.
"""

from pathlib import Path
import tempfile

from harness import parsed
import numpy as np


def main() -> None:
    """Kill and count."""
    from kills import drive, killed, wrong
    args = parsed(__doc__, kills=50, seed=20260601, longest=(9.0, 's of leg at most'),
                  stage={'choices': ('record', 'stop', 'save'), 'default': 'record'})
    if args.stage != 'record':
        kill_at_files(args)
        return
    driven, lost, found, short, false = drive(), [], 0, 0, 0
    for moment_s in np.random.default_rng(args.seed).uniform(0.0, args.longest, args.kills):
        with tempfile.TemporaryDirectory() as folder:
            left = killed(driven, float(moment_s), Path(folder))
        good = left.marks == [(left.start_ns, 0)] and left.code in (0, 1) and len(left.legs) == 1
        # killed in the first second: nothing after the mark was on the disk, and replay says so
        short += not good and left.moment_s < 1.0 and left.code == 2
        lost.append(left.lost_s)
        found += good
        false += bool(wrong(left))
        print(f'{len(lost):3} killed {left.moment_s:5.2f} s into the leg: {left.lost_s:5.3f} s '
              f'lost, {left.files} files, replay exit {left.code}'
              + ('' if good else f', NO LEG: {left.text.strip().splitlines()[-1:]}'), flush=True)
    print(f'{len(lost)} kills: lost {max(lost):.3f} s at most, {np.mean(lost):.3f} s on average; '
          f'{found} legs found by their mark and replayed, {short} '
          'killed in the first second with nothing on the disk yet; '
          f'{false} wrong and not rejected')


def kill_at_files(args) -> None:
    """Kill while results are computed and written, and count."""
    from kills import drive, killed_at_files, wrong
    driven, bad = drive(), 0
    longest = min(args.longest, {'stop': 4.0, 'save': 0.5}[args.stage])
    moments = np.random.default_rng(args.seed).uniform(0.0, longest, args.kills)
    for count, moment_s in enumerate(moments, 1):
        with tempfile.TemporaryDirectory() as folder:
            left = killed_at_files(driven, args.stage, float(moment_s), Path(folder))
        good = not left.half and left.latest and left.journal[0] in (0, 1) and not wrong(left)
        bad += not good
        print(f'{count:3} killed {moment_s:5.2f} s after {args.stage}: {len(left.whole)} whole, '
              f'{len(left.half)} half, journal exit {left.journal[0]}' + ('' if good else ', BAD'),
              flush=True)
    print(f'{args.kills} kills, {bad} bad')


if __name__ == '__main__':
    main()
