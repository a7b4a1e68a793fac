# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Names of parameters in other systems, and the source of each name.

Facts only, copied manually from the source, independent of the code that writes the files.
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
# ros2_controllers, mecanum_drive_controller, jazzy: group kinematics; Odometry::setWheelsParams
MECANUM_KINEMATICS = {'wheels_radius', 'sum_of_robot_center_projection_on_X_Y_axis'}
# ros2_controllers, omni_wheel_drive_controller_parameters.yaml
OMNI_WHEEL_DRIVE = {'wheel_offset', 'robot_radius', 'wheel_radius'}
# ros2_controllers, diff_drive_controller_parameter.yaml: six values, in the order of a Twist
TWIST_COVARIANCE = 'twist_covariance_diagonal'
# VINS-Fusion forks with wheels (VIW-Fusion), estimator/parameters.cpp; m/s per sqrt(Hz)
WHEEL_INERTIAL = 'wheel_velocity_noise_sigma'
DEVICES = {              # begin of the line that the system receives
    'u-blox': 'CFG-SFODO-FACTOR = ',          # ZED-F9R application note UBX-22035176, page 22
    'SBG': 'gain: ',                          # sbg_ros2_driver, config/example; sbgEComCmdOdo.h
    'OxTS': 'Pulses per metre = ',            # RT3000 manual, NAVconfig, wheel speed input
    'NovAtel': 'SETWHEELPARAMETERS ',         # novatel_span_driver; OEM7 SPAN manual v14, page 119
    'ArduPilot': 'WENC_RADIUS '}              # AP_WheelEncoder.cpp
UBLOX_FACTOR_ID = '0x40070007'                # u-blox_config_keys.h of SparkFun; ublox_dgnss
# parameters in docs/recipes.md and config/ekf_odocal.yaml: node -> parameters
RECIPES = {
    # robot_localization, params/ekf.yaml
    'ekf_filter_node': {'frequency', 'sensor_timeout', 'two_d_mode', 'publish_tf', 'odom_frame',
                        'base_link_frame', 'world_frame', 'twist0', 'twist0_queue_size',
                        'twist0_config'},
    # navigation2, nav2_bringup/params/nav2_params.yaml
    'bt_navigator': {'odom_topic', 'global_frame', 'robot_base_frame'},
    # slam_toolbox, config/mapper_params_online_async.yaml
    'slam_toolbox': {'odom_frame', 'map_frame', 'base_frame'},
    # autoware, speed_scale_corrector (or _estimator), declare_parameter in its parameters
    'speed_scale_corrector': {'initial_speed_scale_factor',
                              'initial_speed_scale_factor_covariance'}}
# ArduPilot, AP_WheelEncoder.cpp and AP_NavEKF_Source.cpp
ARDUPILOT = {'WENC_TYPE', 'WENC_CPR', 'WENC_RADIUS', 'WENC_POS_Y', 'WENC2_RADIUS',
             'EK3_SRC1_VELXY'}
# LIO-SAM, config/params.yaml; FAST_LIO, config/velodyne.yaml
LIDAR_INERTIAL = {'extrinsicRot', 'extrinsicTrans', 'extrinsic_R', 'extrinsic_T'}
