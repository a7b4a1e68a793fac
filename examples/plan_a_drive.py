# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ask before driving how good a calibration will be."""

import math

from odocal_ros import plan

GRADE = {'imu.grade': 'industrial'}
for turns in (0, 2, 4):
    drive = plan(distance=2000, speed=12, turns=turns, fix=1.5, config=GRADE)
    scale, yaw = drive.sigma('scale_factor'), drive.sigma('yaw_mounting_angle')
    print(f'{turns} turns: scale {1e6 * scale:.0f} ppm, ' + (
        'no yaw' if yaw is None else f'yaw {math.degrees(yaw):.3f} deg'))

better = plan(distance=2000, speed=12, turns=4, fix=0.02, config=GRADE)
print(f'with RTK: scale {1e6 * better.sigma("scale_factor"):.0f} ppm, {better.verdict.value}')
for reason in better.reasons:
    print(f'{reason.code.name}: {reason.remedy}')
