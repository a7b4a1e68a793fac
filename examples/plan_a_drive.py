# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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
