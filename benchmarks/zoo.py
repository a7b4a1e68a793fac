# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A zoo of real vehicles: does the product say what is so, and say nothing that is not.

    python benchmarks/zoo.py --drives 100 [--only EFFECT] [--kind town] [--grade industrial]
                             [--jobs 2] [--file F]

Each drive is of a vehicle drawn by ``odocal_ros/sim/draw.py`` (docs/zoo.md), all effects at once
or one alone (``--only clean``: none), configured as its operator would. Drive k of a run has seed
70_000_000 + 1_000_000 e + k, fixed before the first run; e counts the effects, 0 for all. Kinds of
drive and grades take turns, so that 15 drives hold each pair once. Rows go to the file line by
line: an interrupted run continues where it stopped.

Printed by effect, kind and grade, for scale, yaw and pitch by the IMU's own axes (and by its
housing, where the product states that): how many were given in drives that are not rejected, share
within 1.96 sigma, RMS of error over sigma, median sigma, worst error over sigma. ``off``: not
rejected though beyond 3.5 sigma; ``unnamed``: of these, without a reason that names a cause that
is there (that the model does not fit names none); ``silent``: without any reason that something
there explains; ``accepted``: with that verdict. ``false reasons``: drives with a reason that
nothing in them explains.
"""

from dataclasses import asdict
import math
import os
from pathlib import Path
import sys
import time

os.environ.setdefault('OMP_NUM_THREADS', '1')     # two processes, two cores
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from harness import configured, parsed, read_rows, run_missing
from zoo_table import print_tables

from odocal_ros.sim.draw import draw_vehicle, DRAWN_GRADES, EFFECTS, KINDS, RARE

CLEAN = 'clean'
RUNS = ('all', *EFFECTS, CLEAN, *RARE)     # in the order of their seeds
FIRST_SEED, SEEDS_A_RUN = 70_000_000, 1_000_000
BLOCK = 3       # drives a process does before it reports


def seeds_of(run, drives, kind, grade):
    """Return the first seeds of a run whose drives are of a kind and a grade, None: of any."""
    first, found, k = FIRST_SEED + SEEDS_A_RUN * RUNS.index(run), [], 0
    while len(found) < drives:
        if kind in (None, kind_of(k)) and grade in (None, grade_of(k)):
            found.append(first + k)
        k += 1
    return found


def kind_of(k):
    """Return the kind of a run's drive k."""
    return KINDS[k % len(KINDS)]


def grade_of(k):
    """Return the grade of a run's drive k: five kinds, three grades, each pair once in 15."""
    return DRAWN_GRADES[k % len(DRAWN_GRADES)]


def run_drive(seed, duration=None):
    """Draw, drive, calibrate; return a row."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.sim.scenarios import simulate
    e, k = divmod(seed - FIRST_SEED, SEEDS_A_RUN)
    run, kind, grade = RUNS[e], kind_of(k), grade_of(k)
    effects = None if run == 'all' else () if run == CLEAN else (run,)
    options, there = draw_vehicle(seed, kind, grade, effects,
                                  **{} if duration is None else {'duration': duration})
    begin = time.process_time()
    drive = simulate(options)
    row = {'seed': seed, 'run': run, 'kind': kind, 'grade': grade, 'effects': list(there),
           'drawn': compact(drive.options), 'asked': duration,
           'simulated': time.process_time() - begin}
    config, begin = configured(drive), time.process_time()
    try:
        calibration = combine([calibrate(drive.leg(), config)], config)
    except Exception as error:      # a defect, to be counted and not to end the run
        return row | {'verdict': 'failed', 'codes': [f'{type(error).__name__}: {error}']}
    return row | {'seconds': time.process_time() - begin, **outcome(calibration, drive.truth)}


def compact(options):
    """Return the drawn values that differ from a plain drive, to four digits."""
    from odocal_ros.sim.options import resolve, SimOptions
    plain = asdict(resolve(SimOptions(scenario=options.scenario, odometer=options.odometer)))
    drawn = asdict(options)
    plain, drawn = plain | plain.pop('real'), drawn | drawn.pop('real')
    return {name: short(value) for name, value in drawn.items()
            if value != plain[name] and name not in ('seed', 'scenario', 'imu_grade')}


def short(value):
    """Return numbers of four digits."""
    if isinstance(value, tuple):
        return [short(v) for v in value]
    return float(f'{value:.4g}') if isinstance(value, float) else value


def outcome(calibration, truth):
    """Return verdict, codes and, for each figure, value, sigma and error (scale: relative)."""
    row = {'verdict': calibration.verdict.value,
           'codes': sorted({r.code.name for r in calibration.reasons})}
    found = calibration.estimates
    for name, key, true, unit in (('scale_factor', 'scale', truth.scale, truth.scale),
                                  ('yaw_mounting_angle', 'yaw', truth.yaw, 1.0),
                                  ('pitch_mounting_angle', 'pitch', truth.pitch, 1.0)):
        estimate = found.get(name)
        if estimate is None or estimate.value is None:
            continue
        row |= {key: estimate.value, f'{key}_sigma': estimate.sigma / unit,
                f'{key}_error': (estimate.value - true) / unit, f'{key}_by': estimate.method}
        if key != 'scale':
            row |= against_housing(calibration, name, key, getattr(truth, f'{key}_housing'))
    smoother = calibration.legs[0].methods.get('smoother')
    details = smoother.details if smoother else {}
    return row | {name: details[name] for name in ('iterations', 'settled', 'widened')
                  if isinstance(details.get(name), int | float | bool)}


def against_housing(calibration, name, key, true):
    """Return the error against the housing's angle, and its sigma where the product states one."""
    estimate = calibration.estimates[name]
    details = calibration.methods[estimate.method].details
    row = {f'{key}_housing_error': estimate.value - true}
    if 'beside' in details:
        row[f'{key}_housing_sigma'] = details['beside'][f'{name}_housing_sigma']['value']
    return row


def main():
    """Run what the file does not hold yet, print the tables."""
    args = parsed(__doc__, drives=(30, 'of each run'),
                  only={'choices': RUNS[1:], 'action': 'append', 'default': [],
                        'metavar': 'EFFECT',
                        'help': f'one effect alone; repeatable: {", ".join(RUNS)}'},
                  kind={'choices': KINDS}, grade={'choices': DRAWN_GRADES},
                  duration=(float, 's of a drive (600; straight 720)'), jobs=(2, 'processes'),
                  file=Path('/tmp/zoo.jsonl'))
    if args.duration is not None and not math.isfinite(args.duration):
        sys.exit('--duration: required: a finite number')
    seeds = [seed for run in args.only or ['all']
             for seed in seeds_of(run, args.drives, args.kind, args.grade)]
    have = {seed: row for seed, row in read_rows(args.file).items()
            if row.get('asked') == args.duration}
    print_tables(run_missing(run_drive, seeds, have, args.file, args.jobs, args.duration,
                             block=BLOCK))


if __name__ == '__main__':
    main()
