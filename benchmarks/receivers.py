# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Receivers, odometers, roads and IMUs as vehicles have them: is each named, does the sigma hold.

    python benchmarks/receivers.py [--drives 40] [--only RUN] [--jobs 1] [--file F]

Vehicles are those of the zoo (docs/zoo.md) with the effect of one row (RUNS) and no other; by
turns an industrial IMU with RTK and a consumer IMU with slow fix errors. Drives take 300 s, with
two tunnels of 120 s 900 s. Drive k of row e has seed 91_000_000 + 1_000_000 e + k, fixed before
the first run. Rows go to the file line by line: an interrupted run continues where it stopped.

Printed by row, as a table of docs/validation.md: drives with a scale that are not rejected; share
within 1.96 sigma, rms and largest of scale error over sigma; accepted drives, and how many of them
are beyond 4 sigma; median sigma; in how many drives a reason of ``names`` is given, and of those
whose scale the effect moves by more than the stated sigma: against the same drive calibrated
without it; false WHEEL_SLIP. Then yaw and pitch, and all reasons.
Last, by reason: false alarms, in all rows whose effect it does not name (``names``, ``also``).
Drives of spins in which no wheel spins are left out.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
import os
from typing import Any

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from alarms import DEG, RTK
from harness import configured, run_by_name
import numpy as np
from slip_alarms import SPEED, SPINS, spins_of
from zoo import outcome
from zoo_table import BY_KIND, FIGURES, NEVER_FALSE, print_errors, WITHIN

FIRST_SEED, SEEDS_A_RUN = 91_000_000, 1_000_000
VEHICLES = (('industrial', RTK), ('consumer', {'fix_noise': 'correlated', 'fix_sigma': 1.5}))
ROADS = ('town', 'motorway', 'out_and_back')
KMH = 1 / 3.6
G = 9.81
BEYOND = 4.0


@dataclass(frozen=True)
class Run:
    """
    A row of the table.

    names : reasons that name the effect.   also : further reasons that are true of it.
    """

    real: dict[str, Any] = field(default_factory=dict)       # fields of RealEffects
    options: dict[str, Any] = field(default_factory=dict)    # SimOptions
    kinds: tuple[str, ...] = ROADS
    names: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()    # of the zoo
    change: Any = None               # of the leg: called with drive, leg, rng


def fused(error, seconds):
    """Return the row of a receiver with an odometer of its of_run."""
    return Run({'receiver_odometer': error, 'receiver_odometer_time': seconds},
               names=('FIXES_FOLLOW_ODOMETER',))


def tunnels(length, begins, duration):
    """Return the row of a receiver that dead-reckons through two tunnels."""
    return Run({'tunnels': tuple((b, length) for b in begins), 'tunnel_odometer': 0.02,
                'tunnel_heading': DEG}, {'duration': duration}, names=('FIXES_DEAD_RECKONED',))


def tracked(seconds):
    """Return the row of a receiver that filters position and velocity."""
    return Run({'receiver_tracking': seconds}, names=('FIXES_SMOOTHED',), also=('DELAY_SEEN',))


def on_change(kmh):
    """Return the row of a speed that is sent on change."""
    return Run({'speed_hold': kmh * KMH}, SPEED | {'odometer_rate': 50.0},
               names=('SPEED_ON_CHANGE',))


def lost(drive, leg, rng):
    """Lose one IMU row in a hundred, and ten times 50 to 200 ms of them."""
    from odocal_ros.data.samples import take
    stamp = leg.imu.stamp_ns
    keep = rng.random(len(stamp)) > 0.01
    for at in rng.choice(stamp[200:-200], 10, replace=False):
        keep &= (stamp < at) | (stamp > at + 1e9 * rng.uniform(0.05, 0.2))
    return replace(leg, imu=take(leg.imu, keep))


def stepping(drive, leg, rng):
    """Set the clock of the IMU by 20 ms three times, to either side."""
    stamp = leg.imu.stamp_ns
    off = np.zeros(len(stamp), np.int64)
    for at in rng.choice(stamp[1000:-1000], 3, replace=False):
        off[stamp >= at] += 20_000_000 * rng.choice((-1, 1))
    return replace(leg, imu=replace(leg.imu, stamp_ns=stamp + off))


def aliased(drive, leg, rng):
    """Shake by the second order of an engine, 4 Hz per m/s and 70 at rest, without a filter."""
    t = (leg.imu.stamp_ns - drive.options.start_ns) * 1e-9
    turned = np.cumsum((70.0 + 4.0 * np.abs(drive.motion.speed(t)))
                       * np.diff(t, prepend=t[:1])) * 2 * np.pi
    f, w = (np.sin(turned[:, None] + rng.uniform(0, 2 * np.pi, 3)) * size for size in (
        0.5, 0.2 * DEG))
    return replace(leg, imu=replace(leg.imu, f_i=leg.imu.f_i + f, w_i=leg.imu.w_i + w))


def saturated(drive, leg, rng):
    """Cut the specific force at 2 g."""
    return replace(leg, imu=replace(leg.imu, f_i=np.clip(leg.imu.f_i, -2 * G, 2 * G)))


ROBOT = {'alternating_crossfall': 2 * DEG, 'alternating_crossfall_length': 20.0, 'kerbs': 0.08,
         'wheelbase': 0.5}
SHAKEN = ('IMU_WORSE_THAN_GRADE', 'MODEL_MISMATCH')
RUNS = {
    'plain': Run(kinds=(*ROADS, 'yard')),
    'fused fixes, 2 %, 20 s': fused(0.02, 20.0),
    'fused fixes, 2 %, 5 s': fused(0.02, 5.0),
    'fused fixes, 0.3 %, 20 s': fused(0.003, 20.0),
    'fused fixes, 0.3 %, 5 s': fused(0.003, 5.0),
    'robot, kerbs, cross slopes': Run(ROBOT, kinds=('yard',)),
    'tunnels, 2 x 120 s': tunnels(120.0, (200.0, 550.0), 900.0),
    'tunnels, 2 x 30 s': tunnels(30.0, (80.0, 180.0), 300.0),
    'tunnels, 2 x 10 s': tunnels(10.0, (80.0, 180.0), 300.0),
    'filtered fixes, 1 s': tracked(1.0),
    'filtered fixes, 0.5 s': tracked(0.5),
    'filtered speed, 0.4 s': Run({'speed_filter': 0.4}, SPEED | {'odometer_rate': 20.0},
                                 names=('SPEED_FILTERED',), also=('DELAY_SEEN',)),
    'speed on change, 0.5 km/h': on_change(0.5),
    'speed on change, 0.2 km/h': on_change(0.2),
    'reflections, 8 to 20 m': Run({'bursts': 60.0, 'burst_size': 12.6, 'burst_spread': 0.28},
                                  effects=('reflections',), names=('FIXES_NOISIER_THAN_SAID',)),
    'late fixes, 0.1 to 0.4 s': Run({'fix_jitter': 0.087}, {'fix_delay': 0.25},
                                    names=('DELAY_SEEN',),
                                    also=('FIXES_NOISIER_THAN_SAID',)),
    'oval, left turns only': Run(kinds=('oval',)),
    'banked oval': Run({'banking': 0.5}, kinds=('oval',)),
    'crossfall, 2.5 %': Run({'constant_crossfall': 0.025}, effects=('squat', 'sideslip')),
    'kneeling bus': Run({'kneeling': 2 * DEG}, kinds=('town',), effects=('squat',)),
    'lost IMU rows': Run(change=lost),
    'IMU clock 50 ppm': Run({'odometer_clock_rate': -5e-5, 'fix_clock_rate': -5e-5},
                            names=('CLOCKS_DRIFT',)),
    'IMU clock steps by 20 ms': Run(change=stepping, names=('CLOCK_SET',)),
    'aliased vibration': Run(change=aliased, names=('IMU_WORSE_THAN_GRADE',), also=SHAKEN),
    'saturated IMU': Run({'vibration': 5.0}, change=saturated, names=('IMU_SATURATED',),
                         also=SHAKEN),
    'spins by 0.5 m': Run(options=SPINS, kinds=('town',), names=('WHEEL_SLIP',)),
}


def run_drive(seed):
    """Draw, drive, calibrate; return a row."""
    e, k = divmod(seed - FIRST_SEED, SEEDS_A_RUN)
    name, run = list(RUNS.items())[e]
    row = {'seed': seed, 'run': name, **driven(seed, k, run)}
    if run.names and 'scale_error' in row and (run.real or run.change):
        without = driven(seed, k, replace(run, real={}, change=None, effects=()))
        row['effect'] = row['scale_error'] - without.get('scale_error', np.nan)
    return row


def driven(seed, k, run):
    """Return the outcome of drive k of a row."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.sim.draw import draw_vehicle
    from odocal_ros.sim.scenarios import simulate
    kind, (grade, fixes) = run.kinds[k // 2 % len(run.kinds)], VEHICLES[k % len(VEHICLES)]
    made, _ = draw_vehicle(seed, kind, grade, run.effects, real=run.real,
                           **{'duration': 300.0, **fixes, **run.options})
    drive = simulate(made)
    config, leg = configured(drive), drive.leg()
    if run.change:
        leg = run.change(drive, leg, np.random.default_rng(seed))
    calibration = combine([calibrate(leg, config)], config)
    return {'kind': kind, 'grade': grade,
            'holds': bool(made.slip_events) and not spins_of(made, drive),
            **outcome(calibration, drive.truth)}


def table(rows):
    """Print by row how far values are off, and what is said."""
    print('| row | drives | share | rms | worst | accepted, beyond 4 | median sigma, ppm '
          '| cause named | false WHEEL_SLIP |\n|---|---|---|---|---|---|---|---|---|')
    by_run = {name: [row for row in rows if row['run'] == name and not row['holds']]
              for name in RUNS}
    for name, of_run in by_run.items():
        if of_run:
            print_row(name, of_run)
    for name, of_run in by_run.items():
        if of_run:
            verdicts = Counter(row['verdict'] for row in of_run)
            print(f'{name}: {len(of_run)} drives, {dict(verdicts)}')
            for key, unit, size in FIGURES[:3]:
                print_errors(key, unit, size, of_run)
            print(f'    {dict(Counter(code for row in of_run for code in row["codes"]))}')
    print_false(by_run)


def print_row(name, of_run):
    """Print a row of the table."""
    names = set(RUNS[name].names)
    given = [row for row in of_run if 'scale_sigma' in row and row['verdict'] != 'rejected']
    z = {row['seed']: abs(row['scale_error']) / row['scale_sigma'] for row in given}
    accepted = [z[row['seed']] for row in given if row['verdict'] == 'accepted']
    moved = [row for row in given if abs(row.get('effect', 0.0)) > row['scale_sigma']]
    named = f'{share(of_run, names)}, moved {share(moved, names)}' if names else ''
    slip = '' if 'WHEEL_SLIP' in names else sum('WHEEL_SLIP' in row['codes'] for row in of_run)
    every = np.array(list(z.values()) or [np.nan])
    print(f'| {name} | {len(given)} of {len(of_run)} | {100 * (every <= WITHIN).mean():.0f} % '
          f'| {np.sqrt((every**2).mean()):.2f} | {every.max():.1f} | {len(accepted)}, '
          f'{sum(x > BEYOND for x in accepted)} '
          f'| {np.median([1e6 * row["scale_sigma"] for row in given] or [np.nan]):.0f} | {named} '
          f'| {slip} |')


def share(rows, names):
    """Return in how many of some rows one of some reasons is given, as text."""
    return f'{sum(bool(names & set(row["codes"])) for row in rows)} of {len(rows)}'


def print_false(by_run):
    """Print by reason its false alarms and their rows."""
    false: dict[str, Counter] = {}
    for name, of_run in by_run.items():
        true = {*RUNS[name].names, *RUNS[name].also}
        for row in of_run:
            for code in {*row['codes']} - true - NEVER_FALSE - BY_KIND.get(row['kind'], set()):
                false.setdefault(code, Counter())[name] += 1
    for code, where in sorted(false.items(), key=lambda item: -item[1].total()):
        without = sum(len(of_run) for name, of_run in by_run.items()
                      if code not in {*RUNS[name].names, *RUNS[name].also})
        print(f'false {code}: {where.total()} of {without} {dict(where)}')


def main():
    """Run what the file does not hold yet, print the table."""
    run_by_name(__doc__, run_drive, list(RUNS), (FIRST_SEED, SEEDS_A_RUN), table,
                '/tmp/receivers.jsonl')


if __name__ == '__main__':
    main()
