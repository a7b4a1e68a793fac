# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a bag lacks for a calibration, as ``odocal inspect`` finds it."""

import math
from typing import Any

from odocal_ros.library.topics import imu_needed
from odocal_ros.offline.inspection_drive import closed
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config


def lacking(found: dict[str, Any], mapping: dict[str, str], config: Config) -> list[Reason]:
    """Return the reasons for data that a calibration would miss."""
    out = [Reason(code, f'no topic for the {word}') for slot, code, word in (
        ('imu', Code.NO_IMU, 'IMU'), ('odometer', Code.NO_ODOMETER, 'odometer'),
        ('fix', Code.NO_FIX, 'fixes'))
        if slot not in mapping and (slot != 'imu' or imu_needed(config))]
    drive = found['drive']
    if not drive:
        return out
    legs = found['legs']
    if not found['standstills']:
        slowest = (f': its lowest speed (mean over 1 s) is {drive["slowest"]:.2f} '
                   'm/s') * (drive['slowest'] > 0)
        out.append(Reason(Code.NO_STANDSTILL, f'the vehicle is never at rest{slowest}'))
    elif legs and not any(abs(leg['start'] - stop) < 1.0
                          for leg in legs for _, stop in found['standstills']):
        out.append(Reason(Code.NO_STANDSTILL, 'no standstill before the drive: the first is '
                          f'at {found["standstills"][0][0]:.1f} s'))
    short = [leg for leg in legs if leg['way'] < config.leg.min_distance]
    loops = [leg for leg in legs if leg not in short and closed(leg)]
    for some, code, said in ((short, Code.LEG_TOO_SHORT, 'path length {way:.0f} m'), (
            loops, Code.CHORD_TOO_SHORT, 'a loop: path length {way:.0f} m, {chord:.0f} m from '
            'start to end')):
        if some:
            many = '' if len(some) == 1 else f'{len(some)} of {len(legs)} legs, as '
            out.append(Reason(code, many + 'the leg {start:.1f}:{stop:.1f} s is '.format(
                **some[0]) + said.format(**some[0])))
    if 0 < drive['fastest'] < config.leg.min_speed:
        out.append(Reason(Code.SPEED_TOO_LOW, 'highest speed (mean over 1 s) '
                          f'{drive["fastest"]:.1f} m/s; the limit is '
                          f'{config.leg.min_speed:g} m/s'))
    return out + _heading(found, mapping, config)


def _heading(found: dict[str, Any], mapping: dict[str, str], config: Config) -> list[Reason]:
    """Return the reason for a missing or poor heading, with possible sources."""
    if 'heading' in mapping or math.isfinite(config.alignment.heading):
        return []
    facts = next(t for t in found['topics'] if t['name'] == mapping['imu'])['imu']
    if not facts['orientation']:
        why = 'no heading topic, and the IMU publishes no orientation'
    elif facts['yaw_sigma'] is None:
        why = 'no heading topic, and the IMU orientation has no covariance'
    elif facts['yaw_sigma'] > config.verdict.max_yaw_sigma:
        why = ('the only heading is the IMU orientation with an uncertainty of '
               f'{math.degrees(facts["yaw_sigma"]):.1f} deg')
    else:
        return []
    return [Reason(Code.YAW_NOT_SEPARABLE, why)]
