# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Effect of a GNSS velocity on the results: drives of the zoo with and without it.

    python benchmarks/zoo_velocity.py --drives 40 [--kind white] [--file F]

The drives are those of ``zoo.py`` with all effects, seeds from 70_000_000 on. Drive k has the k-th
type of velocity error, cyclically, unless ``--kind`` selects one. Output by type, for scale, yaw
and pitch, without and with velocity: share within 1.96 sigma, rms and maximum of error over sigma;
the median ratio of the sigmas, with over without; and the ratio of CPU time.
"""

import os
from pathlib import Path
import time

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from harness import configured, parsed, read_rows, run_missing
import numpy as np
from zoo import FIRST_SEED, grade_of, kind_of, outcome

SIGMA = 0.05        # m/s
ERRORS = {
    'white': {},
    'filtered': {'velocity_lag': 0.5, 'velocity_correlation_time': 0.5},
    'late': {'velocity_delay': 0.2},
    'scale': {'velocity_scale_error': 1e-3},
    'correlated': {'velocity_correlation_time': 5.0},
    'outliers': {'velocity_outliers': 0.05},
    'fused': {'velocity_scale_error': 0.02, 'velocity_correlation_time': 5.0}}


def error_of(seed, kind):
    """Return the type of velocity error of a drive: the one asked for, else by turns."""
    return kind or list(ERRORS)[(seed - FIRST_SEED) % len(ERRORS)]


def run_drive(seed, asked):
    """Return rows of a drive without and with the velocity."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.settings.config import with_settings
    from odocal_ros.sim.draw import draw_vehicle
    from odocal_ros.sim.scenarios import simulate
    k, error = seed - FIRST_SEED, error_of(seed, asked)
    options, _ = draw_vehicle(seed, kind_of(k), grade_of(k), None, velocity_sigma=SIGMA,
                              **ERRORS[error])
    drive = simulate(options)
    row = {'seed': seed, 'error': error, 'kind': kind_of(k), 'grade': grade_of(k)}
    for name, use in (('without', False), ('with', True)):
        config = with_settings(configured(drive), {'gnss.use_velocity': use})
        begin = time.process_time()
        calibration = combine([calibrate(drive.leg(), config)], config)
        row[name] = {'seconds': time.process_time() - begin, **outcome(calibration, drive.truth)}
        smoother = calibration.legs[0].methods.get('smoother')
        details = smoother.details if smoother else {}
        row[name] |= {'external': details.get('external', {}).get('velocity'),
                      'level': details.get('noise', {}).get('velocity')}
    return row


def print_table(name, rows):
    """Print the statistics of some drives."""
    print(f'{name}: {len(rows)} drives')
    for key in ('scale', 'yaw', 'pitch'):
        text = f'  {key:6}'
        for run in ('without', 'with'):
            z = np.array([r[run][f'{key}_error'] / r[run][f'{key}_sigma'] for r in rows
                          if f'{key}_error' in r[run] and r[run]['verdict'] != 'rejected'])
            if len(z):
                text += (f'  {run} {len(z)}: {100 * (abs(z) < 1.96).mean():5.1f} %, '
                         f'rms {np.sqrt((z**2).mean()):.2f}, worst {abs(z).max():.1f};')
        ratio = [r['with'][f'{key}_sigma'] / r['without'][f'{key}_sigma'] for r in rows
                 if all(f'{key}_sigma' in r[run] for run in ('without', 'with'))]
        print(text + (f'  sigmas {np.median(ratio):.3f}' if ratio else ''))
    cpu = [r['with']['seconds'] / r['without']['seconds'] for r in rows]
    print(f'  CPU: {np.median(cpu):.2f}')


def main():
    """Run the drives that are missing in the file, print the tables."""
    args = parsed(__doc__, drives=40, kind={'choices': ERRORS},
                  file=Path('/tmp/zoo_velocity.jsonl'))
    seeds = range(FIRST_SEED, FIRST_SEED + args.drives)
    have = {seed: row for seed, row in read_rows(args.file).items()
            if row['error'] == error_of(seed, args.kind)}
    rows = run_missing(run_drive, seeds, have, args.file, 1, args.kind)
    for error in ERRORS:
        some = [row for row in rows if row['error'] == error]
        if some:
            print_table(error, some)
    print_table('all', rows)


if __name__ == '__main__':
    main()
