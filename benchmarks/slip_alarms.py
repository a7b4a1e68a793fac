# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Slip alarms: how often WHEEL_SLIP is said of wheels that hold, and of wheels that spin by 0.5 m.

    python benchmarks/slip_alarms.py [--drives 15] [--only RUN] [--duration 300] [--jobs 1]
                                     [--file F]

Vehicles are those of the zoo (docs/zoo.md) without any of its effects: an industrial IMU with RTK
and a consumer IMU with slow fix errors by turns, kinds of drive by turns, towns where wheels slip
or the odometer is in steps; ``zoo``: with all effects but slip, tyres and vibration. RUNS names
what is done to the odometer: a delay, jitter of arrival stamps, lost messages, a first-order low
pass, steps of whole km/h at 2 Hz, spins. Drive k of run e has seed 83_000_000 + 1_000_000 e + k,
fixed before the first run. Rows go to the file line by line: an interrupted run continues where
it stopped.

Printed by run: the number of drives with WHEEL_SLIP, DELAY_SEEN and others, the rms and the
largest size of scale error over sigma, the largest size in accepted drives, the median sigma, and
the verdicts. Drives of spins without any spin are left out.
"""

from collections import Counter
from dataclasses import replace
import os
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from alarms import CHEAP, RTK, shifted
from harness import configured, parsed, read_rows, run_missing
import numpy as np
from zoo import KINDS, outcome
from zoo_table import BY_KIND, NEVER_FALSE

FIRST_SEED, SEEDS_A_RUN = 83_000_000, 1_000_000
VEHICLES = (('industrial', RTK), ('consumer', {'fix_noise': 'correlated', 'fix_sigma': 1.5}))
SPEED = {'odometer': 'speed', 'scale': 1.01}
FAST = {'odometer_rate': 50.0}
SPINS = {'slip_events': 60.0, 'slip_size': 0.5}
NOT_OF_ZOO = {'slip', 'speed_law', 'warming', 'vibration', 'coarse_pulses', 'coarse_speed'}


def late(leg, seconds):
    """Return a leg whose odometer is stamped late."""
    return replace(leg, odometer=shifted(leg.odometer, seconds))


def arriving(leg, rng, seconds, lost=0.0):
    """
    Return a leg whose odometer is stamped at arrival, late by an exponential time of that mean.

    Messages keep their order, so one that is late holds up the next.   lost : share of messages.
    """
    sent = leg.odometer
    late_ns = np.round(rng.exponential(seconds, len(sent.stamp_ns)) * 1e9).astype(np.int64)
    stamps = np.maximum.accumulate(sent.stamp_ns + late_ns)
    kept = rng.random(len(stamps)) >= lost
    return replace(leg, odometer=replace(sent, stamp_ns=stamps[kept], received_ns=stamps[kept],
                                         value=sent.value[kept]))


def low_passed(leg, seconds):
    """Return a leg whose odometer, counts or speeds, is low-passed with that time constant."""
    t, value = leg.odometer.stamp_ns * 1e-9, leg.odometer.value
    out = value.astype(float)
    share = -np.expm1(-np.diff(t) / seconds)
    for k in range(1, len(out)):
        out[k] = out[k - 1] + (out[k] - out[k - 1]) * share[k - 1]
    out = np.floor(out) if value.dtype.kind == 'i' else out
    return replace(leg, odometer=replace(leg.odometer, value=out.astype(value.dtype)))


def whole_kmh(leg):
    """Return a leg whose speeds are truncated to whole km/h and sent twice a second."""
    rows = slice(None, None, max(1, round(0.5 / np.median(np.diff(
        leg.odometer.stamp_ns * 1e-9)))))
    sent = leg.odometer
    return replace(leg, odometer=replace(
        sent, stamp_ns=sent.stamp_ns[rows], received_ns=sent.received_ns[rows],
        value=np.trunc(sent.value[rows] * 3.6) / 3.6))


# run: (SimOptions, change of the leg, kinds by turns)
RUNS = {
    'plain': ({}, None, KINDS),
    'zoo': ({}, None, KINDS),
    'late 0.3 s': ({}, lambda leg, _: late(leg, 0.3), KINDS),
    'low pass 0.4 s': ({}, lambda leg, _: low_passed(leg, 0.4), KINDS),
    'km/h at 2 Hz': (SPEED, lambda leg, _: whole_kmh(leg), ('town', 'motorway')),
    'low pass, km/h at 2 Hz': (SPEED, lambda leg, _: whole_kmh(low_passed(leg, 0.4)), ('town',)),
    'spins 0.5 m': (SPINS, None, ('town',)),
    'spins 0.5 m, late 0.3 s': (SPINS, lambda leg, _: late(leg, 0.3), ('town',)),
    'spins 0.5 m, low pass 0.4 s': (SPINS, lambda leg, _: low_passed(leg, 0.4), ('town',)),
    'spins 3 m, km/h at 2 Hz': (SPEED | SPINS | {'slip_size': 3.0}, lambda leg, _: whole_kmh(leg),
                                ('town',)),
    'jitter 5 ms': ({}, lambda leg, rng: arriving(leg, rng, 0.005), KINDS),
    'jitter 20 ms': ({}, lambda leg, rng: arriving(leg, rng, 0.02), KINDS),
    'jitter 50 ms': ({}, lambda leg, rng: arriving(leg, rng, 0.05), KINDS),
    'jitter 20 ms, 50 Hz': (FAST, lambda leg, rng: arriving(leg, rng, 0.02), ('town',)),
    'jitter 50 ms, 50 Hz': (FAST, lambda leg, rng: arriving(leg, rng, 0.05), ('town',)),
    'jitter 20 ms, 1 % lost': ({}, lambda leg, rng: arriving(leg, rng, 0.02, 0.01), ('town',)),
    'speed, jitter 50 ms': (SPEED, lambda leg, rng: arriving(leg, rng, 0.05), ('town',)),
    'speed, low pass 0.4 s': (SPEED, lambda leg, _: low_passed(leg, 0.4), ('town',)),
    'km/h at 2 Hz, late 0.3 s': (SPEED, lambda leg, _: late(whole_kmh(leg), 0.3), ('town',)),
    'spins 0.5 m, jitter 5 ms': (SPINS, lambda leg, rng: arriving(leg, rng, 0.005), ('town',)),
    'spins 0.5 m, jitter 20 ms': (SPINS, lambda leg, rng: arriving(leg, rng, 0.02), ('town',)),
    'spins 0.5 m, jitter 50 ms': (SPINS, lambda leg, rng: arriving(leg, rng, 0.05), ('town',)),
}


def spins_of(made, drive):
    """Return True if a wheel spins in a drive: its last value differs from that without spins."""
    from odocal_ros.sim.scenarios import simulate
    value, without = (d.leg().odometer.value for d in (
        drive, simulate(replace(made, slip_events=0.0))))
    return bool((value != without).any())


def run_drive(seed, duration):
    """Draw, drive, calibrate; return a row."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.sim.draw import draw_vehicle, EFFECTS
    from odocal_ros.sim.scenarios import simulate
    e, k = divmod(seed - FIRST_SEED, SEEDS_A_RUN)
    run = list(RUNS)[e]
    options, change, kinds = RUNS[run]
    effects = tuple(n for n in EFFECTS if n not in NOT_OF_ZOO) if run == 'zoo' else ()
    kind, (grade, fixes) = kinds[k % len(kinds)], VEHICLES[k % len(VEHICLES)]
    settings = CHEAP | fixes | {'duration': duration} | options
    made, _ = draw_vehicle(seed, kind, grade, effects, **settings)
    drive = simulate(made)
    config = configured(drive)
    leg = drive.leg() if change is None else change(
        drive.leg(), np.random.default_rng(seed))
    calibration = combine([calibrate(leg, config)], config)
    return {'seed': seed, 'run': run, 'kind': kind, 'grade': grade, 'asked': duration,
            'holds': 'spins' in run and not spins_of(made, drive),
            'slip': [r.text for r in calibration.reasons if r.code.name == 'WHEEL_SLIP'],
            **outcome(calibration, drive.truth)}


def table(rows):
    """Print by run how often slip is said, what else, and the scale errors."""
    codes = 'WHEEL_SLIP', 'DELAY_SEEN', 'SPEED_FILTERED', 'ODOMETER_LATE'
    print(f'{"":28}{"drives":>7}{"".join(f"{code:>15}" for code in codes)}{"z rms":>7}'
          f'{"most":>6}{"acc.":>6}{"sigma":>7}  verdicts, other reasons')
    for run in RUNS:
        of_run = [row for row in rows if row['run'] == run and not row['holds']]
        if of_run:
            said = ''.join(f'{sum(code in row["codes"] for row in of_run):15}' for code in codes)
            other = Counter(code for row in of_run for code in row['codes'] if code not in codes
                            and code not in NEVER_FALSE | BY_KIND.get(row['kind'], set()))
            print(f'{run:28}{len(of_run):7}{said}{errors(of_run)}  '
                  f'{dict(Counter(row["verdict"] for row in of_run))} {dict(other)}')


def errors(rows):
    """Return rms and largest size of scale error over sigma, of accepted ones, sigma in ppm."""
    z = {row['seed']: abs(row['scale_error']) / row['scale_sigma']
         for row in rows if row.get('scale_sigma')}
    accepted = [z[row['seed']] for row in rows if row['verdict'] == 'accepted']
    sigma = np.median([1e6 * row['scale_sigma'] for row in rows if row['seed'] in z])
    return (f'{np.sqrt(np.mean(np.square(list(z.values())))):7.2f}{max(z.values()):6.1f}'
            f'{max(accepted, default=np.nan):6.1f}{sigma:7.0f}')


def main():
    """Run what the file does not hold yet, print the table."""
    args = parsed(__doc__, drives=(15, 'of each run'),
                  only={'choices': RUNS, 'action': 'append', 'default': [], 'metavar': 'RUN'},
                  duration=(300.0, 's of a drive'), jobs=(1, 'processes'),
                  file=Path('/tmp/slip_alarms.jsonl'))
    have = {seed: row for seed, row in read_rows(args.file).items()
            if row['asked'] == args.duration}
    # by turns, so that what is there after an interruption is of all runs
    seeds = [FIRST_SEED + SEEDS_A_RUN * list(RUNS).index(run) + k for k in range(args.drives)
             for run in args.only or RUNS]
    table(run_missing(run_drive, seeds, have, args.file, args.jobs, args.duration))


if __name__ == '__main__':
    main()
