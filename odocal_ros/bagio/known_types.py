# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Definitions of widely used messages of wheels, for bags that do not contain them.

Until ROS 2 Iron a sqlite3 bag, the default format, had no definitions.
"""

_HEADER = 'std_msgs/Header header\n'
_CORNERS = ('front_left', 'front_right', 'rear_left', 'rear_right')
_DATASPEED = _HEADER + ''.join(f'float32 {corner}\n' for corner in _CORNERS)
_PACMOD_WHEELS = _HEADER + ''.join(f'float64 {corner}_wheel_speed\n' for corner in _CORNERS)
_PACMOD_SPEED = (f'{_HEADER}float64 vehicle_speed\nbool vehicle_speed_valid\n'
                 'uint8[2] vehicle_speed_raw\n')

# format: type -> fields in order, as in its .msg file
KNOWN_DEFINITIONS = {
    **{f'{package}/msg/WheelSpeedReport': _DATASPEED for package in (
        'dbw_fca_msgs', 'dbw_ford_msgs', 'dbw_mkz_msgs', 'dbw_polaris_msgs', 'raptor_dbw_msgs')},
    **{f'{package}/msg/WheelSpeedRpt': _PACMOD_WHEELS for package in (
        'pacmod_msgs', 'pacmod3_msgs')},
    **{f'{package}/msg/VehicleSpeedRpt': _PACMOD_SPEED for package in (
        'pacmod_msgs', 'pacmod3_msgs')},
    'irobot_create_msgs/msg/WheelTicks': f'{_HEADER}int32 ticks_left\nint32 ticks_right\n',
}
