# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Names that other systems give to what they load, and where each name was read.

Facts only, noted by hand from the source named, apart from the code that writes the files.
"""

AUTOWARE_VELOCITY = {    # autoware.universe, sensing/vehicle_velocity_converter, README
    'speed_scale_factor', 'velocity_stddev_xx', 'angular_velocity_stddev_zz', 'frame_id'}
AUTOWARE_IMU = {         # autoware, sensing/autoware_imu_corrector/config/imu_corrector.param.yaml
    *(f'angular_velocity_offset_{a}' for a in 'xyz'),
    *(f'angular_velocity_stddev_{a}{a}' for a in 'xyz')}
ROS2_CONTROLLERS = {     # ros2_controllers, <name>/src/<name>.yaml or <name>_parameter.yaml
    'diff_drive_controller': {'left_wheel_radius_multiplier', 'right_wheel_radius_multiplier',
                              'wheel_separation_multiplier'},
    'ackermann_steering_controller': {'traction_wheels_radius'},
    'tricycle_steering_controller': {'traction_wheels_radius'},
    'bicycle_steering_controller': {'traction_wheel_radius'},
    'tricycle_controller': {'wheel_radius'}}
DEVICES = {              # how the line begins that the system is to be given
    'u-blox': 'CFG-SFODO-FACTOR = ',          # ZED-F9R application note UBX-22035176, page 22
    'SBG': 'gain: ',                          # sbg_ros2_driver, config/example; sbgEComCmdOdo.h
    'OxTS': 'Pulses per metre = ',            # RT3000 manual, NAVconfig, wheel speed input
    'NovAtel': 'SETWHEELPARAMETERS '}         # novatel_span_driver; OEM7 SPAN manual v14, page 119
UBLOX_FACTOR_ID = '0x40070007'                # u-blox_config_keys.h of SparkFun; ublox_dgnss
