# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Use an odometer with an unknown message type: python add_message_type.py BAG.

Here the speed is in vector.x of geometry_msgs/Vector3Stamped. Your own types work in the same way:
their definition is in the bag. For types of many vehicles, add a line to
odocal_ros/messages/odometer_types.py.
"""

import sys

from odocal_ros import calibrate_bag

OURS = {
    'odometer.type': 'geometry_msgs/msg/Vector3Stamped',
    'odometer.field': 'vector.x',        # also wheel.ticks[0], or joints[rear_left]
    'odometer.quantity': 'rate'}         # or cumulative, increment

calibration = calibrate_bag(sys.argv[1], topics={'odometer': '/wheel_speed'}, config=OURS)
print(f'{calibration.verdict.value}: metres per metre claimed '
      f'{calibration.values["scale_factor"]} +- {calibration.sigmas["scale_factor"]}')
