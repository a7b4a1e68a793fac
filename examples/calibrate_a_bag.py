# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrate from a recorded bag: python calibrate_a_bag.py BAG."""

import math
import sys

from odocal_ros import calibrate_bag, OdocalError

try:
    calibration = calibrate_bag(
        sys.argv[1],
        topics={},       # found by their types; else {'imu': '/my_imu', 'odometer': '/ticks'}
        config={'odometer.nominal_scale': 0.02})     # any setting by its name
except OdocalError as error:      # a bag that cannot be used: one sentence says why
    sys.exit(str(error))

print(calibration.verdict.value)
scale = calibration.to_dict()['result']['scale_factor']
if scale['value'] is not None:
    print(f'scale factor {scale["value"]:.7f} +- {scale["sigma"]:.7f} {scale["unit"]}')
yaw = calibration.values['yaw_mounting_angle']
if yaw is not None:
    print(f'yaw mounting {math.degrees(yaw):+.3f} deg')
for reason in calibration.reasons:
    print(f'{reason.code.name}: {reason.text}; {reason.remedy}')
calibration.save('result', force=True)      # the files that odocal replay writes
