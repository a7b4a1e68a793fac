# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Alarms: of each reason that names a sensor's fault, how often it is false and how often it comes.

    python benchmarks/alarms.py [--drives 20] [--only CODE] [--duration 300] [--jobs 1] [--file F]

Vehicles are those of the zoo (docs/zoo.md) without any of its effects, their operators' settings
right. Clean drives are of all kinds and grades, four times ``--drives``, half of them with two
wheels and half with RTK. Each fault is put into drives of a kind that shows it, of a size that
real ones have (FAULTS). Drive k of run e has seed 80_000_000 + 1_000_000 e + k, fixed before the
first run. Rows go to the file line by line: an interrupted run continues where it stopped.

Printed by code: the fault; in how many drives with it the code is said, in how many clean ones;
what else is said of the fault's drives, but for what is never false (zoo_table.NEVER_FALSE).
"""

from collections import Counter
from dataclasses import replace
import os
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from harness import configured, parsed, read_rows, run_missing
import numpy as np
from zoo import DRAWN_GRADES, KINDS
from zoo_table import BY_KIND, NEVER_FALSE

FIRST_SEED, SEEDS_A_RUN = 80_000_000, 1_000_000
CHEAP = {'imu_rate': 50.0, 'odometer_rate': 20.0, 'fix_rate': 5.0}
RTK = {'fix_noise': 'rtk', 'fix_sigma': 0.02}
DEG = np.pi / 180


def shifted(samples, seconds):
    """Return samples whose stamps are late."""
    return replace(samples, stamp_ns=samples.stamp_ns + np.int64(round(seconds * 1e9)))


def unsigned(leg, rng):
    """Let the counter count up whatever the wheel does."""
    step = np.abs(np.diff(leg.odometer.value, prepend=leg.odometer.value[:1]))
    return replace(leg, odometer=replace(leg.odometer, value=np.cumsum(step)))


def delayed_in_bursts(leg, rng):
    """Hold messages of the counter up for 0.1 to 0.5 s, ten times; then they come at once."""
    stamp = leg.odometer.stamp_ns.copy()
    for at in rng.choice(stamp[100:-100], 10, replace=False):
        end = at + round(1e9 * rng.uniform(0.1, 0.5))
        inside = (stamp >= at) & (stamp < end)
        stamp[inside] = end + 200_000 * np.arange(inside.sum())
    return replace(leg, odometer=replace(leg.odometer, stamp_ns=np.sort(stamp)))


def turned_half_way(leg, rng):
    """Turn the IMU by 2 deg about z."""
    from drives import turned
    return replace(leg, imu=turned(leg.imu, leg.imu.stamp_ns[[0, -1]].mean(),
                                   [0.0, 0.0, 2 * DEG]))


def right(leg, wheel):
    """Return a leg with another right wheel."""
    return replace(leg, odometer_right=wheel)


def of_imu(**signals):
    """Return a change of the IMU's signals, each by a function."""
    return lambda leg, rng: replace(leg, imu=replace(leg.imu, **{
        name: change(getattr(leg.imu, name)) for name, change in signals.items()}))


def matrix(scale):
    """Return an accelerometer matrix with a share of y in x (for example 1 deg)."""
    return (0.0, scale, 0.0) + (0.0,) * 6


# code: (fault, kind of drive, SimOptions, fields of RealEffects, settings, change of the leg)
FAULTS: dict = {
    'WHEEL_SLIP': ('spins by 0.5 m, 60 an hour', 'town', {'slip_events': 60.0, 'slip_size': 0.5},
                   {}, {}, None),
    'REVERSING_UNSIGNED': ('a fifth backwards, no sign', 'yard', {'duration': 600.0}, {}, {},
                           unsigned),
    'IMU_WORSE_THAN_GRADE': ('consumer IMU, configured as tactical', 'town',
                             {'imu_grade': 'consumer'}, {}, {'imu.grade': 'tactical'}, None),
    'IMU_AXES_SKEW': ('industrial, accelerometer x 1 deg off', 'town',
                      {'imu_grade': 'industrial'}, {'accel_matrix': matrix(DEG)}, {}, None),
    'FIXES_NOISIER_THAN_SAID': ('1.5 m, stated 0.5 m', 'town', {}, {'stated_sigma_ratio': 1 / 3},
                                {}, None),
    'FIXES_SMOOTHED': ('first order, 0.6 s', 'town', {}, {'receiver_lag': 0.6}, {}, None),
    'DELAY_SEEN': ('fixes 0.3 s late', 'town', {'fix_delay': 0.3}, {}, {}, None),
    'ODOMETER_LATE': ('ten bursts, 0.1 to 0.5 s', 'town', {}, {}, {}, delayed_in_bursts),
    'SPEED_COARSE': ('whole km/h', 'town', {'odometer': 'speed', 'scale': 1.01},
                     {'speed_step': 1 / 3.6}, {}, None),
    'COUNTER_COARSE': ('0.5 m a pulse', 'town', {'scale': 0.5}, {}, {}, None),
    'SCALE_VARIES': ('tyres warm by 0.3 %, RTK', 'town', RTK,
                     {'warming': 0.003, 'warming_time': 200.0}, {}, None),
    'LEVER_ARM_OFF': ('antenna set 0.8 m off', 'town', {},
                      {'antenna_arm_error': (0.8, 0.0, 0.0)}, {}, None),
    'GYROCOMPASS_REFUSED': ('gyro of 1 deg/h, configured as navigation', 'straight',
                            {'imu_grade': 'tactical'}, {}, {
                                'imu.grade': 'navigation',
                                'alignment.heading_source': 'gyrocompass',
                                'method': 'two_point'}, None),
    'CLOCKS_DIFFER': ('fixes of a clock 120 s apart', 'town', {}, {}, {},
                      lambda leg, rng: replace(leg, fix=shifted(leg.fix, 120.0))),
    'IMU_UNITS': ('force in g', 'town', {}, {}, {}, of_imu(f_i=lambda f: f / 9.81)),
    'IMU_AXES': ('IMU turned by 90 deg', 'town', {}, {}, {}, of_imu(
        w_i=lambda w: w[:, [1, 0, 2]] * [1, -1, 1], f_i=lambda f: f[:, [1, 0, 2]] * [1, -1, 1])),
    'GYRO_SIGN': ('gyro counts clockwise', 'town', {}, {}, {}, of_imu(w_i=lambda w: -w)),
    'ODOMETER_REVERSED': ('counts backwards', 'town', {}, {}, {}, lambda leg, rng: replace(
        leg, odometer=replace(leg.odometer, value=-leg.odometer.value))),
    'WHEEL_DEAD': ('right wheel stands', 'town', {'two_wheels': True}, {}, {},
                   lambda leg, rng: right(leg, replace(
                       leg.odometer_right, value=0 * leg.odometer_right.value))),
    'WHEEL_REVERSED': ('right wheel backwards', 'town', {'two_wheels': True}, {}, {},
                       lambda leg, rng: right(leg, replace(
                           leg.odometer_right, value=-leg.odometer_right.value))),
    'WHEELS_SWAPPED': ('left is right', 'town', {'two_wheels': True}, {}, {},
                       lambda leg, rng: replace(leg, odometer=leg.odometer_right,
                                                odometer_right=leg.odometer)),
    'GYRO_AXES': ('gyro x has the wrong sign', 'town', {'duration': 600.0}, {}, {},
                  of_imu(w_i=lambda w: w * [-1.0, 1.0, 1.0])),
    'CHANGE_IN_LEG': ('IMU turned by 2 deg half-way', 'town', {}, {}, {}, turned_half_way),
}
RUNS = ('clean', *FAULTS)


def run_drive(seed, duration):
    """Draw, drive, calibrate; return a row."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.settings.config import with_settings
    from odocal_ros.sim.draw import draw_vehicle
    from odocal_ros.sim.scenarios import simulate
    e, k = divmod(seed - FIRST_SEED, SEEDS_A_RUN)
    code, grade = RUNS[e], DRAWN_GRADES[k % len(DRAWN_GRADES)]
    if code == 'clean':
        kind, real, settings, change = KINDS[k % len(KINDS)], {}, {}, None
        options = {'two_wheels': k % 2 == 1} | (RTK if k // 2 % 2 else {})
    else:
        _, kind, options, real, settings, change = FAULTS[code]
    drawn = CHEAP | {'duration': duration} | options
    made, _ = draw_vehicle(seed, kind, drawn.get('imu_grade', grade), (), real=real, **drawn)
    drive = simulate(made)
    config = with_settings(configured(drive), settings)
    leg = drive.leg() if change is None else change(drive.leg(), np.random.default_rng(seed))
    calibration = combine([calibrate(leg, config)], config)
    return {'seed': seed, 'code': code, 'kind': kind, 'grade': grade, 'asked': duration,
            'verdict': calibration.verdict.value,
            'codes': sorted({r.code.name for r in calibration.reasons})}


def table(rows):
    """Print detections and false alarms by code."""
    clean = [r for r in rows if r['code'] == 'clean']
    print(f'{"":25}{"fault":42}{"said":>9}{"clean":>9}  beside')
    for code, (what, *_) in FAULTS.items():
        with_reason = [r for r in rows if r['code'] == code]
        if not with_reason:
            continue
        beside = Counter(c for r in with_reason for c in r['codes']
                         if c != code and c not in NEVER_FALSE | BY_KIND.get(r['kind'], set()))
        said, false = (sum(code in r['codes'] for r in some) for some in (with_reason, clean))
        print(f'{code:25}{what:42}{f"{said}/{len(with_reason)}":>9}{f"{false}/{len(clean)}":>9}  '
              + ', '.join(f'{c} {n}' for c, n in beside.most_common(4)))
    other = Counter(c for r in clean for c in r['codes'] if c not in FAULTS
                    and c not in NEVER_FALSE | BY_KIND.get(r['kind'], set()))
    print('clean drives, beside:', dict(other) or 'nothing', dict(Counter(
        r['verdict'] for r in clean)))


def main():
    """Run what the file does not hold yet, print the table."""
    args = parsed(__doc__, drives=(20, 'with each fault'),
                  only={'choices': RUNS, 'action': 'append', 'default': [], 'metavar': 'CODE'},
                  duration=(300.0, 's of a drive'), jobs=(1, 'processes'),
                  file=Path('/tmp/alarms.jsonl'))
    have = {seed: row for seed, row in read_rows(args.file).items()
            if row['asked'] == args.duration}
    # by turns, so that what is there after an interruption is of all codes
    seeds = [FIRST_SEED + SEEDS_A_RUN * RUNS.index(code) + k for j in range(args.drives)
             for code in args.only or RUNS
             for k in (range(4 * j, 4 * j + 4) if code == 'clean' else (j,))]
    table(run_missing(run_drive, seeds, have, args.file, args.jobs, args.duration))


if __name__ == '__main__':
    main()
