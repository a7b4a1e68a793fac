# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start the calibrator with its inputs remapped, and RViz beside it if asked."""
# ruff: noqa: I001  (takes the package launch for this folder)

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('odocal_ros')
ARGUMENTS = (
    ('params_file', PathJoinSubstitution([SHARE, 'config', 'calibrator.yaml']),
     'YAML file of settings (see config/calibrator.yaml).'),
    ('imu_topic', 'imu/data', 'sensor_msgs/Imu: turn rates and specific force.'),
    ('odometer_topic', 'odometer', 'Pulse counter, joint state, speed or odometry.'),
    ('odometer_right_topic', 'odometer_right',
     "The right wheel, where odometer.right is 'topic'; as odometer_topic."),
    ('fix_topic', 'fix', 'sensor_msgs/NavSatFix, or a pose without GNSS.'),
    ('fix_velocity_topic', 'fix_velocity',
     'GNSS velocity, TwistStamped or TwistWithCovarianceStamped, ENU; optional.'),
    ('heading_topic', 'heading',
     'sensor_msgs/Imu: ENU yaw of a dual antenna or the like, where alignment.heading_source '
     'allows it.'),
    ('pressure_topic', 'pressure', 'sensor_msgs/FluidPressure: heights; optional.'),
    ('method', '', 'The setting method; empty: what params_file says.'),
    ('namespace', '', 'Namespace of the node and of relative topics.'),
    ('use_sim_time', 'false', 'Take time from /clock, as with a bag or a simulation.'),
    ('rviz', 'false', 'Open RViz with the paths of the last leg (needs the package rviz2).'),
)
REMAPPED = (
    ('imu/data', 'imu_topic'), ('odometer', 'odometer_topic'),
    ('odometer_right', 'odometer_right_topic'), ('fix', 'fix_topic'),
    ('fix_velocity', 'fix_velocity_topic'), ('heading', 'heading_topic'),
    ('pressure', 'pressure_topic'))
SIM_TIME = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}


def calibrator(condition, **settings):
    """Return the node with its settings beside the file's."""
    return Node(
        package='odocal_ros', executable='calibrator', name='calibrator',
        namespace=LaunchConfiguration('namespace'), output='screen', condition=condition,
        parameters=[LaunchConfiguration('params_file'), SIM_TIME | settings],
        remappings=[(topic, LaunchConfiguration(argument)) for topic, argument in REMAPPED])


def generate_launch_description():
    """Return the nodes with their arguments declared."""
    declared = [DeclareLaunchArgument(name, default_value=default, description=about)
                for name, default, about in ARGUMENTS]
    named = PythonExpression(["'", LaunchConfiguration('method'), "' != ''"])
    rviz = Node(
        package='rviz2', executable='rviz2', namespace=LaunchConfiguration('namespace'),
        arguments=['-d', PathJoinSubstitution([SHARE, 'config', 'odocal.rviz'])],
        parameters=[SIM_TIME], condition=IfCondition(LaunchConfiguration('rviz')))
    # first what may be missing: launch gives up there, and would leave a node behind
    return LaunchDescription([
        *declared,
        rviz,
        calibrator(UnlessCondition(named)),
        calibrator(IfCondition(named), method=ParameterValue(LaunchConfiguration('method'),
                                                             value_type=str))])
