# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of the zoo: what a run of drives says of the product, by effect, kind and grade."""

from collections import Counter

import numpy as np

WITHIN, OFF = 1.96, 3.5
MDEG = 1e3 * 180 / np.pi
FIGURES = (('scale', 'ppm', 1e6), ('yaw', 'mdeg', MDEG), ('pitch', 'mdeg', MDEG),
           ('yaw_housing', 'mdeg', MDEG), ('pitch_housing', 'mdeg', MDEG))
# statements about the drive or the sigmas, never false
NEVER_FALSE = {'PARAMETER_NOT_DETERMINED', 'SCALE_SIGMA_TOO_LARGE', 'YAW_SIGMA_TOO_LARGE',
          'YAW_NOT_DETERMINED', 'YAW_NOT_SEPARABLE', 'PITCH_NOT_DETERMINED', 'LEG_NOT_STRAIGHT',
          'CHORD_TOO_SHORT', 'SCALE_NOT_DETERMINED', 'GYROCOMPASS_REFUSED', 'HEADING_UNAVAILABLE',
          'NOT_CONVERGED', 'METHOD_REJECTED'}
BY_KIND = {'yard': {'SPEED_TOO_LOW', 'LEG_TOO_SHORT'}}
GENERAL = {'MODEL_MISMATCH', 'METHODS_DISAGREE'}     # something is wrong, and not what
FIXES = {'FIXES_NOISIER_THAN_SAID', *GENERAL}
IMU = {'IMU_WORSE_THAN_GRADE', 'IMU_AXES_SKEW', *GENERAL}
TYRES = {'SCALE_VARIES'}
WHEELS = {'WHEEL_SLIP', 'TRAVEL_MISSING', 'TRAVEL_EXCESS', *GENERAL}
EXPLAINS = {
    'triads': IMU, 'g_sensitivity': IMU, 'bias': {'TRACK_MISMATCH', *IMU},
    'temperature': {'TRACK_MISMATCH', *IMU},      # values from the standstill are no longer valid
    'vibration': IMU | WHEELS, 'grade': IMU,
    'imu_stamps': {'DELAY_SEEN', 'STAMPS_NOT_RISING', 'CLOCKS_DIFFER', *IMU},
    'coarse_speed': {'SPEED_COARSE', *WHEELS}, 'coarse_pulses': {'COUNTER_COARSE', *GENERAL},
    'odometer_stamps': {'DELAY_SEEN', 'ODOMETER_LATE', 'STAMPS_NOT_RISING', *WHEELS},
    'speed_law': WHEELS | TYRES, 'warming': WHEELS | TYRES, 'slip': WHEELS | TYRES,
    'sideslip': GENERAL,
    'squat': WHEELS,
    'lever_arms': {'LEVER_ARM_OFF', *FIXES},
    'receiver_lag': {'DELAY_SEEN', 'FIXES_SMOOTHED', *GENERAL},
    'fix_stamps': {'DELAY_SEEN', 'STAMPS_NOT_RISING', 'CLOCKS_DIFFER', *GENERAL},
    'slow_errors': FIXES,
    'multipath': {'TRACK_MISMATCH', 'FIXES_UNUSABLE', 'BAD_ROWS_DROPPED', *FIXES},
    'covariance': {'FIXES_UNUSABLE', *FIXES}, 'outages': {'TOPIC_GAP', 'STAMPS_NOT_RISING'}}


def explained(row):
    """Return the codes that something in a row's drive explains."""
    return set(BY_KIND.get(row['kind'], ())).union(
        *(EXPLAINS.get(name, set()) for name in row['effects']))


def off(row):
    """Return True if a row that is not rejected has a value far beyond its sigma."""
    return row['verdict'] in ('accepted', 'caution') and any(
        abs(row[f'{key}_error']) > OFF * row[f'{key}_sigma'] for key, _, _ in FIGURES
        if f'{key}_sigma' in row)


def silent(row):
    """Return True if no reason of a row is explained by an effect of the drive."""
    return not set(row['codes']) & explained(row)


def unnamed(row):
    """Return True if no reason of a row names a cause of the drive."""
    return not set(row['codes']) & explained(row) - GENERAL


def false_codes(row):
    """Return the reasons that nothing explains."""
    return set(row['codes']) - NEVER_FALSE - explained(row)


def print_tables(rows):
    """Print all together, then by run or effect, by kind, by grade; then what was said falsely."""
    runs = list(dict.fromkeys(row['run'] for row in rows))
    print(f'{"":24}{"drives":>6}{"":14}{"given":>6}{"95 %":>7}{"/sigma":>9}{"sigma":>10}'
          f'{"worst":>9}')
    groups = [('together', rows)] if len(runs) > 1 or runs == ['all'] else []
    groups += [(run, [r for r in rows if r['run'] == run]) for run in runs if run != 'all']
    for key in ('kind', 'grade'):
        values = dict.fromkeys(row[key] for row in rows)
        groups += [(value, [r for r in rows if r[key] == value]) for value in values
                   if len(values) > 1]
    whole = [r for r in rows if r['run'] == 'all']
    effects = dict.fromkeys(e for row in whole for e in row['effects'])
    groups += [(f'with {e}', [r for r in whole if e in r['effects']]) for e in effects
               if any(e not in r['effects'] for r in whole)]
    for title, group in groups:
        _print_group(title, group)
    told = Counter(code for row in rows for code in false_codes(row))
    print(f'\nfalse reasons: {dict(told) or "none"}')
    print('off: ' + (', '.join(
        f'{r["seed"]} {r["kind"]} {r["grade"]} {r["verdict"]}{" silent" if silent(r) else ""}'
        for r in rows if off(r)) or 'none'))


def _print_group(title, rows):
    for key, unit, scale in FIGURES:
        have = [r for r in rows if f'{key}_sigma' in r and r['verdict'] != 'rejected']
        if not have and key.endswith('housing'):
            continue
        line = f'{title:24}{len(rows) if title else "":>6} {key:14}{len(have):>5}'
        if have:
            error, sigma = (np.array([r[f'{key}_{what}'] for r in have])
                            for what in ('error', 'sigma'))
            ratio = np.abs(error) / sigma
            line += (f'{100 * (ratio <= WITHIN).mean():7.0f}{(ratio**2).mean()**0.5:9.2f}'
                     f'{np.median(sigma) * scale:8.1f} {unit:4}{ratio.max():6.1f}')
        print(line)
        title = ''
    verdicts = Counter(r['verdict'] for r in rows)
    wrong = [r for r in rows if off(r)]
    false = [r for r in rows if false_codes(r)]
    seconds = [r['seconds'] for r in rows if 'seconds' in r] or [np.nan]
    print(f'{"":4}{dict(verdicts)}; off {len(wrong)}, unnamed {sum(map(unnamed, wrong))}, silent '
          f'{sum(map(silent, wrong))}, accepted '
          f'{sum(r["verdict"] == "accepted" for r in wrong)}; false reasons in {len(false)}; '
          f'{np.median(seconds):.1f} s')


def print_errors(key, unit, size, rows):
    """Print of a value how many rows have it, its errors over sigma, its median sigma."""
    given = [row for row in rows if f'{key}_sigma' in row and row['verdict'] != 'rejected']
    if not given:
        return
    z = np.array([abs(row[f'{key}_error']) / row[f'{key}_sigma'] for row in given])
    accepted = [x for x, row in zip(z, given, strict=True) if row['verdict'] == 'accepted']
    sigma = np.median([row[f'{key}_sigma'] for row in given]) * size
    print(f'    {key:6} given {len(given):3}  share {100 * (z <= WITHIN).mean():4.0f} %  '
          f'rms {np.sqrt((z**2).mean()):5.2f}  worst {z.max():5.1f}  accepted {len(accepted):3}, '
          f'worst {max(accepted, default=np.nan):5.1f}  sigma {sigma:.0f} {unit}')
