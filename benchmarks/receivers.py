# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Receivers, speed signals and roads as vehicles have them: is each named, does the sigma hold.

    python benchmarks/receivers.py [--drives 40] [--only RUN] [--jobs 1] [--file F]

Vehicles are those of the zoo (docs/zoo.md) with one rare effect and no other; by turns an
industrial IMU with RTK and a consumer IMU with slow fix errors. Drive k of run e has seed
91_000_000 + 1_000_000 e + k, fixed before the first run. Rows go to the file line by line: an
interrupted run continues where it stopped.

Printed by run: for scale, yaw and pitch of the drives that are not rejected, how many were given,
the share within 1.96 sigma, the rms and the largest of error over sigma, of accepted drives too,
and the median sigma; verdicts; in how many drives each reason was given. NAMES holds the reasons
that name the effect: of drives whose scale is off by more than its stated sigma, how many name it.
"""

import argparse
from collections import Counter
import os
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from alarms import RTK
import numpy as np
from resumed import read_rows, run_missing
from zoo import configured, outcome
from zoo_table import FIGURES, WITHIN

FIRST_SEED, SEEDS_A_RUN = 91_000_000, 1_000_000
VEHICLES = (('industrial', RTK), ('consumer', {'fix_noise': 'correlated', 'fix_sigma': 1.5}))
ROADS = ('town', 'motorway', 'out_and_back')
BANKED = {'banking': 0.5}
RUNS = {        # effects, kinds of drive, figures of Real, reasons that name it
    'plain': ((), (*ROADS, 'yard'), {}, ()),
    'fused_fixes': (('fused_fixes',), ROADS, {}, ('FIXES_FOLLOW_ODOMETER',)),
    'tracked_fixes': (('tracked_fixes',), ROADS, {}, ('FIXES_SMOOTHED', 'DELAY_SEEN')),
    'held_speed': (('held_speed',), ROADS, {}, ('SPEED_ON_CHANGE',)),
    'filtered_speed': (('filtered_speed',), ROADS, {}, ('SPEED_FILTERED',)),
    'late_fixes': (('late_fixes',), ROADS, {}, ('FIXES_LATE', 'DELAY_SEEN')),
    'tunnels': (('tunnels',), ROADS, {}, ('FIXES_DEAD_RECKONED',)),
    'reflections': (('reflections',), ROADS, {}, ('FIXES_NOISIER_THAN_SAID',)),
    'kerbs': (('kerbs',), ('yard',), {}, ()),
    'cross_slopes': (('kerbs',), ROADS, {}, ()),
    'oval': ((), ('oval',), {}, ()),
    'banked oval': ((), ('oval',), BANKED, ()),
}


def run_drive(seed):
    """Draw, drive, calibrate; return a row."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.sim.draw import drawn
    from odocal_ros.sim.scenarios import simulate
    e, k = divmod(seed - FIRST_SEED, SEEDS_A_RUN)
    run = list(RUNS)[e]
    effects, kinds, figures, _ = RUNS[run]
    kind, (grade, fixes) = kinds[k // 2 % len(kinds)], VEHICLES[k % len(VEHICLES)]
    made, _ = drawn(seed, kind, grade, effects, real=figures, **fixes)
    drive = simulate(made)
    config = configured(drive)
    calibration = combine([calibrate(drive.leg(), config)], config)
    return {'seed': seed, 'run': run, 'kind': kind, 'grade': grade,
            **outcome(calibration, drive.truth)}


def table(rows):
    """Print by run how far values are off, and what is said."""
    for run, (_, _, _, names) in RUNS.items():
        own = [row for row in rows if row['run'] == run]
        if not own:
            continue
        print(f'{run}: {len(own)} drives, {dict(Counter(row["verdict"] for row in own))}')
        for key, unit, size in FIGURES[:3]:
            _print_figure(key, unit, size, [row for row in own if f'{key}_sigma' in row])
        off = [row for row in own if 'scale_sigma' in row
               and abs(row['scale_error']) > row['scale_sigma']]
        if names:
            print(f'    named in {sum(bool(set(names) & set(row["codes"])) for row in own)} of '
                  f'{len(own)}, of those more than a sigma off in '
                  f'{sum(bool(set(names) & set(row["codes"])) for row in off)} of {len(off)}')
        print(f'    {dict(Counter(code for row in own for code in row["codes"]))}')


def _print_figure(key, unit, size, rows):
    z = np.array([abs(row[f'{key}_error']) / row[f'{key}_sigma'] for row in rows])
    given = np.array([row['verdict'] != 'rejected' for row in rows], dtype=bool)
    accepted = [x for x, row in zip(z, rows, strict=True) if row['verdict'] == 'accepted']
    if not given.any():
        return
    sigma = np.median([row[f'{key}_sigma'] for row in rows]) * size
    print(f'    {key:6} given {given.sum():3}  share {100 * (z[given] <= WITHIN).mean():4.0f} %  '
          f'rms {np.sqrt((z[given]**2).mean()):5.2f}  worst {z[given].max():5.1f}  accepted '
          f'{len(accepted):3}, worst {max(accepted, default=np.nan):5.1f}  sigma '
          f'{sigma:.0f} {unit}')


def main():
    """Run what the file does not hold yet, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--drives', type=int, default=40, help='of each run')
    parser.add_argument('--only', choices=RUNS, action='append', default=[], metavar='RUN')
    parser.add_argument('--jobs', type=int, default=1, help='processes')
    parser.add_argument('--file', type=Path, default=Path('/tmp/receivers.jsonl'))
    args = parser.parse_args()
    have = read_rows(args.file)
    # by turns, so that what is there after an interruption is of all runs
    seeds = [FIRST_SEED + SEEDS_A_RUN * list(RUNS).index(run) + k for k in range(args.drives)
             for run in args.only or RUNS]
    table(run_missing(run_drive, seeds, have, args.file, args.jobs))


if __name__ == '__main__':
    main()
