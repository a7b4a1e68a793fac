"""Start the calibrator with its inputs remapped."""
# ruff: noqa: I001  (takes the package launch for this folder)

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = (
    ('params_file', PathJoinSubstitution([FindPackageShare('odocal_ros'), 'config',
                                          'calibrator.yaml']),
     'YAML file of settings (see config/calibrator.yaml).'),
    ('imu_topic', 'imu/data', 'sensor_msgs/Imu: turn rates and specific force.'),
    ('odometer_topic', 'odometer', 'Pulse counter, joint state, speed or odometry.'),
    ('fix_topic', 'fix', 'sensor_msgs/NavSatFix: GNSS positions.'),
    ('namespace', '', 'Namespace of the node and of relative topics.'),
    ('use_sim_time', 'false', 'Take time from /clock, as with a bag or a simulation.'),
)


def generate_launch_description():
    """Return the node with its arguments declared."""
    declared = [DeclareLaunchArgument(name, default_value=default, description=about)
                for name, default, about in ARGUMENTS]
    node = Node(
        package='odocal_ros', executable='calibrator', name='calibrator',
        namespace=LaunchConfiguration('namespace'), output='screen',
        parameters=[LaunchConfiguration('params_file'), {
            'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'),
                                           value_type=bool)}],
        remappings=[(topic, LaunchConfiguration(f'{argument}_topic')) for topic, argument in (
            ('imu/data', 'imu'), ('odometer', 'odometer'), ('fix', 'fix'))])
    return LaunchDescription([*declared, node])
