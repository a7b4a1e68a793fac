"""Calibrate from a recorded bag: python calibrate_a_bag.py BAG."""

import math
import sys

from odocal_ros import calibrate_bag

calibration = calibrate_bag(
    sys.argv[1],
    topics={'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/fix'},    # found if left away
    config={'odometer.nominal_scale': 0.02})         # any setting by its name

print(calibration.verdict.value)
scale, sigma = (x['scale_factor'] for x in (calibration.values, calibration.sigmas))
if scale is not None:
    print(f'scale factor {scale:.7f} +- {sigma:.7f} m/pulse')
yaw = calibration.values['yaw_mounting_angle']
if yaw is not None:
    print(f'yaw mounting {math.degrees(yaw):+.3f} deg')
for reason in calibration.reasons:
    print(f'{reason.code.name}: {reason.text}; {reason.remedy}')
calibration.save('result', force=True)      # the files that odocal replay writes
