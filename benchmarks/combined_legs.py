# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Legs of a vehicle combined by their shared constants: stated sigmas and errors.

    python benchmarks/combined_legs.py [--vehicles 4] [--legs 6] [--grade consumer]
                                       [--fixes correlated|white|rtk] [--file F]

A vehicle has one scale, one mounting and one IMU, whose scale errors are drawn from its grade
(accelerometer: grades.GRADES, gyro: a third of that); biases, road, wheels and fixes are different
in each leg. The scale error of the accelerometer is the same on all axes; the vertical one changes
the pitch by its product with the pitch, which is not a constant. Legs are town drives of
10 minutes, a quarter of an hour apart. Leg j of vehicle k has seed 61_000_000 + 100 k + j.

Printed for scale, yaw and pitch: median stated sigma and RMS of error over sigma of one leg, of
all legs combined and, for comparison, of the mean of the same legs weighted by variances
(as ``two_point`` is combined); chi-square of the legs over its freedom; the sigma by which
constants scatter between them.
Rows are kept in the file: an interrupted run continues where it stopped.
"""

import os
from pathlib import Path
import time

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from harness import parsed, read_rows, run_missing
import numpy as np
from smoother_cells import simulated

FIRST_SEED, APART = 61_000_000, 15 * 60 * 10**9       # ns
NAMES = {'scale_factor': ('scale, ppm', 1e6), 'yaw_mounting_angle': ('yaw, mdeg', 1e3 * 57.29578),
         'pitch_mounting_angle': ('pitch, mdeg', 1e3 * 57.29578)}


def driven(vehicle, legs, grade, fixes):
    """Return the results of a vehicle's legs, when they were driven, settings and truth."""
    from smoother_legs import leg_of

    from odocal_ros.estimator import smooth
    from odocal_ros.settings.nominal import GRADES
    from odocal_ros.sim.noise import make_rng
    seed = FIRST_SEED + 100 * vehicle
    rng, of_grade = make_rng(seed, 'what the vehicle is'), GRADES[grade]
    drawn = {'accel_scale_error': float(of_grade.accel_scale_sigma * rng.standard_normal()),
           'gyro_scale_error': float(of_grade.gyro_scale_sigma / 3 * rng.standard_normal()),
           'scale': float(0.0213 * np.exp(0.01 * rng.standard_normal())),
           'yaw': float(np.deg2rad(2.0) * rng.standard_normal()),
           'pitch': float(np.deg2rad(1.0) * rng.standard_normal())}
    results, times = [], []
    for j in range(legs):
        drive, config = simulated(
            seed + j, scenario='town', duration=600.0, imu_grade=grade, fix_noise=fixes,
            start_ns=1_750_000_000_000_000_000 + j * APART, **drawn)
        results.append(smooth(leg_of(drive.leg(), config), config))
        times.append(drive.truth.start_ns)
    return results, times, config, drive.truth


def off(method, truth):
    """Return (error, sigma) of each parameter, relative and rad; None where it is refused."""
    found = {}
    for name, true in zip(NAMES, (truth.scale, truth.yaw, truth.pitch), strict=True):
        e = method.estimates[name]
        size = true if name == 'scale_factor' else 1.0
        found[name] = None if e.value is None else ((e.value - true) / size, e.sigma / size)
    return found


def run_vehicle(vehicle, legs, grade, fixes):
    """Drive, fit, combine; return a row."""
    from odocal_ros.calib.combine import combine_method
    from odocal_ros.estimator.several import combine_legs
    begin = time.process_time()
    results, times, config, truth = driven(vehicle, legs, grade, fixes)
    good = [(r, t) for r, t in zip(results, times, strict=True) if r.marginal]
    together = combine_legs(*zip(*good, strict=True), config)
    return {'seed': vehicle, 'legs': [off(r, truth) for r in results],
            'combined': off(together, truth),
            'mean': off(combine_method('smoother', [r for r, _ in good]), truth),
            'disagreement': together.details['disagreement'],
            'codes': sorted({r.code.name for r in together.reasons}),
            'seconds': time.process_time() - begin}


def table(rows):
    """Print stated sigma and error over sigma of one leg and of all."""
    print(f'{"":14}{"":>10}{"stated":>10}{"RMS error":>11}{"/sigma":>8}{"worst":>7}{"of":>5}')
    for name, (title, unit) in NAMES.items():
        for label, found in (('one leg', [leg for r in rows for leg in r['legs']]),
                             ('mean', [r['mean'] for r in rows]),
                             ('combined', [r['combined'] for r in rows])):
            e = np.array([f[name] for f in found if f[name]])
            if not len(e):
                continue
            z = e[:, 0] / e[:, 1]
            print(f'{title:14}{label:>10}{np.median(e[:, 1]) * unit:10.1f}'
                  f'{np.sqrt((e[:, 0]**2).mean()) * unit:11.1f}{np.sqrt((z**2).mean()):8.2f}'
                  f'{np.abs(z).max():7.2f}{len(e):5d}')
            title = ''
    of = [r['disagreement'] for r in rows]
    print('chi2 / freedom:', ', '.join(f'{d["chi2"]:.0f}/{d["freedom"]}' for d in of))
    for name, (text, by) in NAMES.items():
        scatter = [d['between_legs'][name] * by for d in of if name in d['between_legs']]
        print(f'between legs, {text}:', ', '.join(f'{x:.1f}' for x in scatter) or 'nothing')


def main():
    """Run what the file does not hold yet, print the table."""
    args = parsed(__doc__, vehicles=4, legs=6, grade='consumer', fixes='correlated', file=Path)
    path = args.file or Path(f'/tmp/combined_{args.grade}_{args.fixes}_{args.legs}.jsonl')
    table(run_missing(run_vehicle, range(args.vehicles), read_rows(path), path, 1, args.legs,
                      args.grade, args.fixes))


if __name__ == '__main__':
    main()
