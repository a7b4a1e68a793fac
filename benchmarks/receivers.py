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

from collections import Counter
import os

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from alarms import RTK
from harness import configured, run_by_name
from zoo import outcome
from zoo_table import FIGURES, print_errors

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
    'clocks': (('clocks',), ROADS, {}, ('CLOCKS_DRIFT',)),
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
            print_errors(key, unit, size, own)
        off = [row for row in own if 'scale_sigma' in row
               and abs(row['scale_error']) > row['scale_sigma']]
        if names:
            print(f'    named in {sum(bool(set(names) & set(row["codes"])) for row in own)} of '
                  f'{len(own)}, of those more than a sigma off in '
                  f'{sum(bool(set(names) & set(row["codes"])) for row in off)} of {len(off)}')
        print(f'    {dict(Counter(code for row in own for code in row["codes"]))}')


def main():
    """Run what the file does not hold yet, print the table."""
    run_by_name(__doc__, run_drive, list(RUNS), (FIRST_SEED, SEEDS_A_RUN), table,
                '/tmp/receivers.jsonl')


if __name__ == '__main__':
    main()
