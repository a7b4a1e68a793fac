# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Monte Carlo of the two-point method, to see whether the stated sigma holds.

    python benchmarks/two_point_cells.py [--drives 2000] [--processes 2] [--only TEXT] [--file F]

Each cell (scenario, IMU grade, kind of fix noise) is driven N times through ``pipeline.calibrate``
with new random errors: gyro and accelerometer biases, walks and noise, heading, fixes, where the
encoder's disc stands. Printed for scale and yaw: mean error, RMS error, RMS of error / stated
sigma, share of errors within 1.96 stated sigmas. Goal at N = 2000: ratio 0.93 to 1.07, share
93.5 to 96.5 % (its own noise there is 1.6 % and 0.5 %, 1 sigma). Drive k of cell c has seed
30_000_000 + 100_000 c + k, fixed before the first run. Tactical drives are given a heading with an
error of 3.6' (the paper's), navigation ones gyrocompass. ``yaw - heading`` is the yaw with the
heading error and its share of the sigma taken out, so that the small sources are seen too.

The motion is computed once a cell and only the errors are redrawn, at low sensor rates. Results go
to the file line by line: an interrupted run continues where it stopped.
"""

import dataclasses
from itertools import product
import math
import os
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')     # two processes, two cores

from harness import parsed, read_rows, run_missing
import numpy as np

SCENARIOS, GRADES, NOISES = ('paper', 'straight', 'out_and_back'), ('navigation', 'tactical'), \
    ('white', 'correlated')
CELLS = list(product(SCENARIOS, GRADES, NOISES))
FIRST_SEED, SEEDS_A_CELL = 30_000_000, 100_000
HEADING_SIGMA = math.radians(3.6 / 60)
RATES = {'imu_rate': 10.0, 'odometer_rate': 5.0, 'fix_rate': 2.0}
BLOCK = 50      # drives a process does before it reports
GOAL_RATIO, GOAL_SHARE = (0.93, 1.07), (93.5, 96.5)


class Cell:
    """The true part of a cell's drives, made once; ``drive`` puts errors on it."""

    def __init__(self, scenario: str, grade: str, noise: str) -> None:
        from odocal_ros.sim import scenarios, sensors
        from odocal_ros.sim.motion import contact_travel
        from odocal_ros.sim.noise import PHASE, stamps
        self.options = scenarios.resolve(scenarios.SimOptions(
            scenario=scenario, imu_grade=grade, fix_noise=noise, **RATES))
        clean = dataclasses.replace(self.options, imu_grade='perfect', fix_sigma=0.0)
        self.motion = scenarios.motion_of(self.options)
        self.imu, self.fix = sensors.imu(self.motion, clean), sensors.fixes(self.motion, clean)
        self.covariance = sensors.fixes(self.motion, self.options).covariance_n
        ns, t = stamps(self.motion.duration, self.options.odometer_rate, PHASE['odometer'])
        self.odometer_ns = self.options.start_ns + ns
        self.pulses = contact_travel(self.motion.at(t), (0.0, 0.0, 0.0)) / self.options.scale
        self.truth = scenarios._truth(self.motion, self.options, self.imu)
        self.stop_ns = self._stop_ns() if scenario == 'out_and_back' else self.truth.stop_ns

    def _stop_ns(self) -> int:
        """Return the mark an operator sets before turning: the end of the first stop."""
        t = (self.imu.stamp_ns - self.options.start_ns) * 1e-9
        moves = np.abs(self.motion.speed(t)) > 1e-9
        stood_again = np.flatnonzero(~moves[1:] & moves[:-1])[0] + 1
        moves_again = stood_again + int(np.argmax(moves[stood_again:]))
        return int(self.imu.stamp_ns[moves_again - 1])

    def leg(self, seed: int):
        """Return one drive's leg, all errors drawn from a seed."""
        from odocal_ros.data.leg import LegRecorder
        from odocal_ros.data.samples import OdometerSamples
        from odocal_ros.nav.geodesy import radii
        from odocal_ros.sim import sensors
        from odocal_ros.sim.noise import make_rng
        options = dataclasses.replace(self.options, seed=seed)
        gyro, accel = sensors.imu_errors(options, len(self.imu.stamp_ns))
        imu = dataclasses.replace(self.imu, w_i=self.imu.w_i + gyro, f_i=self.imu.f_i + accel)
        error = sensors.fix_errors((self.fix.stamp_ns - options.start_ns) * 1e-9, options)
        meridian, normal = radii(self.fix.latitude)
        height = self.fix.height
        fix = dataclasses.replace(
            self.fix, latitude=self.fix.latitude + error[:, 1] / (meridian + height),
            longitude=self.fix.longitude
            + error[:, 0] / ((normal + height) * np.cos(self.fix.latitude)),
            height=height + error[:, 2], covariance_n=self.covariance)
        phase = make_rng(seed, 'pulse phase L').uniform()
        counts = sensors.FIRST_COUNT + np.floor(self.pulses + phase).astype(np.int64)
        recorder = LegRecorder()
        for slot, block in (('imu', imu), ('fix', fix), ('odometer', OdometerSamples(
                self.odometer_ns, self.odometer_ns, counts))):
            recorder.feed(slot, block)
        return recorder.close(self.truth.start_ns, self.stop_ns)

    def config(self, seed: int):
        """Return the settings of such a drive, and the error of the heading, rad."""
        from odocal_ros.settings.config import Config, with_settings
        from odocal_ros.sim.noise import make_rng
        settings = {'imu.grade': self.options.imu_grade,
                    'odometer.nominal_scale': self.options.nominal_scale}
        if self.options.imu_grade == 'navigation':
            return with_settings(Config(), settings | {
                'method': 'two_point',
                'alignment.heading_source': 'gyrocompass'}), None
        error = HEADING_SIGMA * make_rng(seed, 'known heading').standard_normal()
        return with_settings(Config(), settings | {
                'method': 'two_point',
            'alignment.heading_source': 'fixed',
            'alignment.heading': float(self.truth.heading + error),
            'alignment.heading_sigma': HEADING_SIGMA}), float(error)

    def drive(self, seed: int) -> dict:
        """Calibrate one drive; return errors and stated sigmas (scale: relative; rad)."""
        from odocal_ros.pipeline.calibrate import calibrate
        config, heading_error = self.config(seed)
        result = calibrate(self.leg(seed), config)
        method = result.methods['two_point']
        scale, yaw = (method.estimates[n] for n in ('scale_factor', 'yaw_mounting_angle'))
        row = {'seed': seed, 'verdict': result.verdict.value,
               'codes': sorted({r.code.name for r in (*result.reasons, *method.reasons)})}
        if scale.value is not None and yaw.value is not None:
            row |= {'scale': scale.value / self.truth.scale - 1,
                    'scale_sigma': scale.sigma / scale.value,
                    'yaw': yaw.value - self.truth.yaw, 'yaw_sigma': yaw.sigma}
            if heading_error is not None:       # clockwise, the yaw counter-clockwise
                by_heading = method.details['budget']['initial_heading']['yaw_mounting_angle']
                row |= {'rest': row['yaw'] + heading_error,
                        'rest_sigma': math.sqrt(max(yaw.sigma**2 - by_heading**2, 0.0))}
        return row


_cells: dict[int, Cell] = {}


def run_drive(seed: int) -> dict:
    """Return the row of a drive; its cell is kept for the next ones of this process."""
    number = (seed - FIRST_SEED) // SEEDS_A_CELL
    if number not in _cells:
        _cells.clear()
        _cells[number] = Cell(*CELLS[number])
    return {'cell': number, **_cells[number].drive(seed)}


def main() -> None:
    """Run what the file does not hold yet, print the table."""
    args = parsed(__doc__, drives=(2000, 'drives a cell'), processes=2,
                  only=('', "cells whose name holds this, e.g. 'paper'"),
                  file=Path('/tmp/two_point_cells.jsonl'))
    wanted = [c for c in range(len(CELLS)) if args.only in ' '.join(CELLS[c])]
    seeds = {number: [FIRST_SEED + SEEDS_A_CELL * number + k for k in range(args.drives)]
             for number in wanted}
    have = {row['seed']: row for row in run_missing(
        run_drive, [seed for cell in seeds.values() for seed in cell], read_rows(args.file),
        args.file, args.processes, block=BLOCK)}
    print(f'{"cell":34}{"of":>6} {"":15}{"mean error":>11}{"RMS":>10}{"RMS/sigma":>11}'
          f'{"within 95 %":>13}')
    for number, of_cell in seeds.items():
        _print_cell(' '.join(CELLS[number]), [have[seed] for seed in of_cell])


def _print_cell(name, rows):
    for label, key, unit in (('scale, ppm', 'scale', 1e6), ('yaw, mdeg', 'yaw', 1e3),
                             ('yaw - heading', 'rest', 1e3)):
        have = [r for r in rows if key in r]
        if not have:
            continue
        error = np.array([r[key] for r in have])
        z = error / np.array([r[f'{key}_sigma'] for r in have])
        factor = unit if key == 'scale' else unit * math.degrees(1.0)
        ratio, share = math.sqrt((z**2).mean()), 100 * (np.abs(z) <= 1.96).mean()
        good = (GOAL_RATIO[0] <= ratio <= GOAL_RATIO[1]
                and GOAL_SHARE[0] <= share <= GOAL_SHARE[1])
        print(f'{name:34}{len(have):6d} {label:15}{error.mean() * factor:+11.3f}'
              f'{math.sqrt((error**2).mean()) * factor:10.3f}{ratio:11.3f}{share:13.2f}'
              f'{"" if good else "  <-"}')
        name = ''
    if len(have := [r for r in rows if 'scale' not in r]):
        print(f'  {len(have)} drives without a scale or a yaw: '
              f'{sorted({c for r in have for c in r["codes"]})}')


if __name__ == '__main__':
    main()
