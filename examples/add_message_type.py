# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
