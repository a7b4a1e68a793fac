# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Launch files use the names of the node; changes of parameters fixed at start-up are refused."""

import math
from pathlib import Path

from bench import ROOT, wait_for
from launch_stand_in import of_python, of_xml
import pytest
from rclpy.parameter import Parameter
import yaml

from odocal_ros.data.inputs import TOPICS
from odocal_ros.live.params import change_refusal, refuse_after_start, RESULTS
from odocal_ros.messages.message_fields import FIX, IMU
from odocal_ros.settings.config import Config
from odocal_ros.settings.node_configs import ApplyConfig

PYTHON, XML = (ROOT / 'launch' / f'calibrator.launch.{kind}' for kind in ('py', 'xml'))
CASES = [
    {}, {'rviz': 'true'}, {'method': 'two_point', 'use_sim_time': 'true'},
    {'namespace': 'truck', 'rviz': 'true', 'params_file': '/tmp/mine.yaml'},
    {name + '_topic': f'/a/{name}' for name in ('imu', 'odometer', 'odometer_right', 'fix',
                                                'fix_velocity', 'heading', 'pressure')}]


@pytest.mark.parametrize('given', CASES, ids=lambda given: ' '.join(given) or 'as is')
def test_both_launch_files_start_the_same_nodes(given):
    declared_python, python = of_python(PYTHON, given)
    declared_xml, xml = of_xml(XML, given)
    assert declared_python == declared_xml
    assert all(description.endswith('.') or description.endswith(').')
               for _, description in declared_xml.values())
    assert set(given) <= set(declared_xml)
    assert python == xml
    # RViz first: launch ends if RViz is not installed, and would leave the node running
    assert [node.executable for node in python] == [
        'rviz2'] * (given.get('rviz') == 'true') + ['calibrator']


def test_every_input_can_be_remapped_and_otherwise_has_its_default_topic():
    _, (node,) = of_python(PYTHON, {})
    assert node.remappings == {topic: topic for topic in TOPICS.values()}
    _, (node,) = of_python(PYTHON, CASES[-1])
    assert set(node.remappings.values()) == set(CASES[-1].values())
    # an empty method keeps the one of the file
    assert 'method' not in node.parameters[1]
    _, (node,) = of_python(PYTHON, {'method': 'two_point'})
    assert node.parameters[1]['method'] == 'two_point'


def test_the_files_that_launch_names_are_installed():
    _, (rviz, node) = of_xml(XML, {'rviz': 'true'})
    setup = (ROOT / 'setup.py').read_text()
    for path in (Path(node.parameters[0]), Path(rviz.arguments[1])):
        assert path.exists()
        assert f"glob('{path.parent.name}/*')" in setup
    assert f"'{node.executable} = odocal_ros.live.node_commands:calibrator'" in setup


@pytest.mark.parametrize(('read', 'path'), [(of_python, PYTHON), (of_xml, XML)],
                         ids=['python', 'xml'])
def test_the_launched_node_subscribes_to_configured_topics(start, connect, tmp_path, read, path):
    from odocal_ros.live.messages import message_class
    mine = tmp_path / 'mine.yaml'
    mine.write_text(yaml.safe_dump({'/**/calibrator': {'ros__parameters': {
        'odometer': {'type': 'std_msgs/msg/Int64', 'right': 'topic'},
        'gnss': {'use_velocity': True}}}}))
    given = {'params_file': str(mine), 'namespace': 'truck', 'method': 'two_point',
             'imu_topic': '/a/imu', 'odometer_topic': '/a/left', 'odometer_right_topic': 'right',
             'fix_topic': 'gps/fix', 'fix_velocity_topic': '/a/speed', 'heading_topic': 'compass'}
    _, (node,) = read(path, given)
    start({}, *node.command_line())
    client = connect('/truck/calibrator')
    names = {'/a/imu': IMU, '/a/left': 'std_msgs/msg/Int64',
             '/truck/right': 'std_msgs/msg/Int64', '/truck/gps/fix': FIX,
             '/a/speed': 'geometry_msgs/msg/TwistStamped', '/truck/compass': IMU}
    for name, kind in names.items():
        client.node.create_publisher(message_class(kind), name, 10)
    for name in names:
        wait_for(lambda name=name: client.node.count_subscribers(name), f'a subscriber of {name}')
    assert client.get('method', 'use_sim_time') == ['two_point', False]


def test_launch_accepts_the_files_where_it_is_installed():
    launch = pytest.importorskip('launch', reason='launch is not on PyPI')
    pytest.importorskip('launch_ros', reason='launch_ros is not on PyPI')
    from launch.frontend import Parser
    scope: dict = {'__file__': str(PYTHON)}
    exec(compile(PYTHON.read_text(), str(PYTHON), 'exec'), scope)
    assert isinstance(scope['generate_launch_description'](), launch.LaunchDescription)
    entity, parser = Parser.load(str(XML))
    assert isinstance(parser.parse_description(entity), launch.LaunchDescription)


def values_of(**values):
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]


def test_a_change_of_a_fixed_or_result_parameter_is_refused_with_the_remedy():
    text = change_refusal(Config(), RESULTS, values_of(odometer__type='std_msgs/msg/Int64'))
    assert text == ('odometer.type is fixed at start-up: restart the node with '
                    '"--ros-args -p odometer.type:=VALUE"')
    assert not change_refusal(Config(), RESULTS,
                              values_of(odometer__type='auto', leg__min_speed=1.0,
                                             imu__lever_arm=[0.0, 0.0, 0.0]))
    assert 'imu.lever_arm is fixed' in change_refusal(Config(), RESULTS,
                                                      values_of(imu__lever_arm=[0.0, 0.0, 1.0]))
    # ``ros2 param load`` of the file that the node wrote is accepted
    here = RESULTS | {'result.scale_factor': 0.05}
    assert not change_refusal(Config(), here, values_of(result__scale_factor=0.05,
                                          result__yaw_mounting_angle=math.nan))
    text = change_refusal(Config(), here, values_of(result__scale_factor=0.06))
    assert 'result.scale_factor is set by the node' in text
    assert '--params-file calibration.yaml' in text


def test_the_node_odometry_refuses_all_changes_after_start_up():
    refuse = refuse_after_start(ApplyConfig)
    for values in ({'levelling': False}, {'publish__rate': 5.0}, {'result__valid': True}):
        answer = refuse(values_of(**values))
        assert not answer.successful, values
        assert 'is only read at start-up: restart the node with it' in answer.reason
    assert refuse(values_of(use_sim_time=True, leg__min_distance=5.0)).successful
