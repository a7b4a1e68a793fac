# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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
