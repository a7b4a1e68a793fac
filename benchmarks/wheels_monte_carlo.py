# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Monte Carlo simulation of drives with two wheels: test of the stated sigmas.

    python benchmarks/wheels_monte_carlo.py [--drives 200] [--processes 1] [--cell TEXT] [--file F]

Each cell (scenario, IMU grade, fix noise, known values) is driven N times for 300 s with two
wheels (IMU 50 Hz, wheels 20 Hz, fixes 5 Hz), with new random errors from the priors of the
settings: gyro and accelerometer biases, random walks and noise, the gyro scale (by its grade),
fixes, angles of the encoder discs, latency of the fixes (50 ms), of the odometer (10 ms), the
antenna position (0.1 m), and the track width if it is given (2 %); routes of the town are random
too. The whole pipeline runs, as for a recording. Printed for the scale of the mean, of each wheel,
for the ratio of right to left, the yaw mounting angle and the track width: mean error, RMS error,
median stated sigma, RMS of error / stated sigma, share within 1.96 sigmas. Goal at N = 2000: ratio
0.93 to 1.07, share 93.5 to 96.5 % (its own noise there is 1.6 % and 0.5 %, 1 sigma). Drive k of
cell c has seed 40_000_000 + 100_000 c + k, fixed before the first run. Results go to the file line
by line: an interrupted run continues where it stopped.
"""

import math
import os
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
from harness import parsed, read_rows, run_missing
import numpy as np

CELLS = {
    'town consumer white': {},
    'town industrial white': {'imu_grade': 'industrial'},
    'town consumer correlated': {'fix_noise': 'correlated'},
    'straight industrial white': {'scenario': 'straight'},
    'straight tactical white': {'scenario': 'straight', 'imu_grade': 'tactical'},
    'town consumer white, width given': {'given': True},
    'town industrial white, angles': {'imu_grade': 'industrial', 'odometer': 'angle'},
    'town consumer white, outliers': {'outliers': 0.02, 'outlier_size': 30.0},
    'town industrial correlated': {'imu_grade': 'industrial', 'fix_noise': 'correlated'},
    'town consumer white, slip': {'slip_walk': 0.01},
    'town consumer rtk': {'fix_noise': 'rtk'},
    'straight industrial, width given': {'scenario': 'straight', 'given': True},
    'town industrial rtk': {'imu_grade': 'industrial', 'fix_noise': 'rtk'},
}
FIRST_SEED, SEEDS_A_CELL = 40_000_000, 100_000
CHEAP = {'duration': 300.0, 'imu_rate': 50.0, 'odometer_rate': 20.0, 'fix_rate': 5.0}
LATENCY, LATE_ODOMETER, ARM, WIDTH = 0.05, 0.01, 0.1, 0.02     # as the settings' defaults
BLOCK = 20      # drives a process does before it reports
GOAL_RATIO, GOAL_SHARE = (0.93, 1.07), (93.5, 96.5)


def drive(seed: int) -> dict:
    """Calibrate one drive; return errors and stated sigmas (scales: relative; rad; m)."""
    from odocal_ros.pipeline.calibrate import calibrate
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.settings.nominal import GRADES
    from odocal_ros.sim.noise import make_rng
    from odocal_ros.sim.options import DEFAULTS
    from odocal_ros.sim.scenarios import SimOptions, simulate
    options = {'scenario': 'town', 'two_wheels': True} | CHEAP | list(CELLS.values())[
        (seed - FIRST_SEED) // SEEDS_A_CELL]
    given = options.pop('given', False)
    grade = GRADES[options.get('imu_grade', DEFAULTS[options['scenario']]['imu_grade'])]
    draw = make_rng(seed, 'what the settings believe').standard_normal(7)
    made = simulate(SimOptions(
        seed=seed, fix_delay=float(LATENCY * draw[0]), odometer_delay=float(
            LATE_ODOMETER * draw[1]), antenna_lever_arm=tuple(map(float, ARM * draw[2:5])),
        gyro_scale_error=float(grade.gyro_scale_sigma * draw[6]), **options))
    settings = {'method': 'smoother', 'imu.grade': made.options.imu_grade,
                'odometer.nominal_scale': float(made.options.nominal_scale)}
    if given:
        settings['odometer.track_width'] = float(made.options.track_width
                                                 * (1 + WIDTH * draw[5]))
    leg = calibrate(made.leg(), with_settings(Config(), settings))
    method = leg.methods['smoother']
    truth = {'scale_factor': made.truth.scale, 'yaw_mounting_angle': made.truth.yaw,
             'scale_factor_left': made.truth.wheel_scales[0],
             'scale_factor_right': made.truth.wheel_scales[1],
             'track_width': made.options.track_width}
    row = {'seed': seed, 'codes': sorted({r.code.name for r in method.reasons})}
    for name, true in truth.items():
        e = method.estimates[name]
        if e.value is not None:
            size = true if name.startswith('scale') else 1.0
            error = math.remainder(e.value - true, 2 * math.pi)
            row |= {name: error / size, f'{name}_sigma': e.sigma / size}
    left, right = (row.get(f'scale_factor_{side}') for side in ('left', 'right'))
    if left is not None:
        row |= {'ratio': (right - left) / (1 + left),
                'ratio_sigma': 2 * method.details['wheels']['left']['ratio_sigma']}
    return row


def main() -> None:
    """Run what the file does not hold yet, print the table."""
    args = parsed(__doc__, drives=(200, 'drives a cell'), processes=1,
                  cell=('', "the cell of this name, else those whose name holds it, e.g. 'town'"),
                  file=Path('/tmp/wheels_monte_carlo.jsonl'))
    wanted = [i for i, name in enumerate(CELLS) if args.cell == name] or [
        i for i, name in enumerate(CELLS) if args.cell in name]
    seeds = {number: [FIRST_SEED + SEEDS_A_CELL * number + k for k in range(args.drives)]
             for number in wanted}
    have = {row['seed']: row for row in run_missing(
        drive, [seed for cell in seeds.values() for seed in cell], read_rows(args.file), args.file,
        args.processes, block=BLOCK)}
    print(f'{"cell":34}{"of":>6} {"":15}{"mean error":>11}{"RMS":>10}{"sigma":>10}'
          f'{"RMS/sigma":>11}{"within 95 %":>13}')
    for number, of_cell in seeds.items():
        print_cell(list(CELLS)[number], [have[seed] for seed in of_cell])


def print_cell(name, rows) -> None:
    """Print what came of a cell's drives."""
    for label, key, unit in (('scale, ppm', 'scale_factor', 1e6),
                             ('left, ppm', 'scale_factor_left', 1e6),
                             ('right, ppm', 'scale_factor_right', 1e6),
                             ('ratio, ppm', 'ratio', 1e6),
                             ('yaw, mdeg', 'yaw_mounting_angle', 1e3 * math.degrees(1.0)),
                             ('width, mm', 'track_width', 1e3)):
        have = [r for r in rows if key in r]
        if not have:
            continue
        error = np.array([r[key] for r in have])
        sigma = np.array([r[f'{key}_sigma'] for r in have])
        z = error / sigma
        ratio, share = math.sqrt((z**2).mean()), 100 * (np.abs(z) <= 1.96).mean()
        good = (GOAL_RATIO[0] <= ratio <= GOAL_RATIO[1]
                and GOAL_SHARE[0] <= share <= GOAL_SHARE[1])
        print(f'{name:34}{len(have):6d} {label:15}{error.mean() * unit:+11.3f}'
              f'{math.sqrt((error**2).mean()) * unit:10.3f}{np.median(sigma) * unit:10.3f}'
              f'{ratio:11.3f}{share:13.2f}'
              f'{"" if good else "  <-"}')
        name = ''


if __name__ == '__main__':
    main()
