# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Topics by message type: one candidate is taken, several or none are told with the remedy."""

import pytest

from odocal_ros.bagio.read import TopicInfo
from odocal_ros.errors import BadUsage
from odocal_ros.library.topics import choose_topics, local_reference
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
IMU, FIX = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/NavSatFix'
INT, TWIST = 'std_msgs/msg/Int64', 'geometry_msgs/msg/TwistStamped'
BASE = {'/imu/data': IMU, '/odometer': INT, '/fix': FIX}
ODD = {'/rosout': 'rcl_interfaces/msg/Log', '/cmd_vel': 'geometry_msgs/msg/Twist',
       '/calibrator/odometer': INT, '/tf': 'tf2_msgs/msg/TFMessage'}


def topics(**types):
    """Return the base topics and more; a name's __ is a slash; None takes one away."""
    named = BASE | {'/' + name.replace('__', '/'): t for name, t in types.items()}
    return {n: TopicInfo(n, t, 5) for n, t in named.items() if t}


def choose(found, overrides=None, **settings):
    config = with_settings(Config(), {k.replace('__', '.'): v for k, v in settings.items()})
    return choose_topics(found, config, overrides or {})


def test_one_of_each():
    wanted = {'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/fix'}
    assert choose(topics()) == wanted
    assert choose(topics() | {n: TopicInfo(n, t, 5) for n, t in ODD.items()}) == wanted
    # without a message a topic is none
    assert choose(topics() | {'/imu/raw': TopicInfo('/imu/raw', IMU, 0)}) == wanted


def test_several_are_listed_with_their_option():
    with pytest.raises(BadUsage, match=r'3 topics can be the odometer; choose one with '
                       r'--odometer-topic: /odometer \(std_msgs/msg/Int64\), /speed'):
        choose(topics(speed=TWIST, wheels='sensor_msgs/msg/JointState'))
    with pytest.raises(BadUsage, match='can be the IMU.*--imu-topic.*can be the fix.*--fix-topic'):
        choose(topics(imu__raw=IMU, phone=FIX))       # all at once
    assert choose(topics(speed=TWIST), {'odometer': 'speed'})['odometer'] == '/speed'
    assert choose(topics(speed=TWIST), odometer__type=TWIST)['odometer'] == '/speed'
    assert choose(topics(odometry__filtered='nav_msgs/msg/Odometry'))['odometer'] == '/odometer'


def test_missing_lists_what_there_is():
    with pytest.raises(BadUsage, match=r'no IMU \(a topic of sensor_msgs/msg/Imu\) in the bag; '
                       r'the bag has /odometer \(std_msgs/msg/Int64\), /fix'):
        choose(topics(imu__data=None))
    with pytest.raises(BadUsage, match=r'no IMU \(a topic of sensor_msgs/msg/Imu besides '
                       r'/imu/data\) in the bag'):
        choose(topics(), {'heading': '/imu/data'})
    with pytest.raises(BadUsage, match='--fix-topic /gps: no such topic; the bag has /imu/data'):
        choose(topics(), {'fix': '/gps'})
    # not as if the others were missing, which it would be taken from
    with pytest.raises(BadUsage, match='^--imu-topic /fix: the topic is of '
                       'sensor_msgs/msg/NavSatFix, which cannot be used as IMU; the bag has '
                       '/imu/data'):
        choose(topics(), {'imu': '/fix'})
    for slot, topic in (('odometer', '/imu/data'), ('odometer_right', '/fix'),
                        ('fix', '/odometer'), ('heading', '/fix'), ('fix_velocity', '/odometer')):
        with pytest.raises(BadUsage, match='which cannot be used as '):
            choose(topics(), {slot: topic})
    foreign = topics(ticks='my_msgs/msg/Ticks')
    assert choose(foreign, {'odometer': '/ticks'})['odometer'] == '/ticks'
    with pytest.raises(BadUsage, match='the topic has no message'):
        choose(topics() | {'/gps': TopicInfo('/gps', FIX, 0)}, {'fix': '/gps'})
    with pytest.raises(BadUsage, match='no odometer'):
        choose(topics(), odometer__type='my_msgs/msg/Ticks')


def test_only_a_fused_odometer_is_better_than_none_but_a_command_is_not():
    found = topics(odometer=None, localization__fused='nav_msgs/msg/Odometry')
    assert choose(found)['odometer'] == '/localization/fused'
    with pytest.raises(BadUsage, match='no odometer'):
        choose(topics(odometer=None, cmd_vel='geometry_msgs/msg/Twist'))


def test_fixes_are_not_needed_when_the_ends_are_surveyed():
    found = choose(topics(fix=None), reference__start=[48.0, 11.0, 500.0, 0.01],
                   reference__end=[48.1, 11.0, 500.0, 0.01])
    assert 'fix' not in found


def test_velocity_is_taken_where_its_name_is_the_receivers():
    assert 'fix_velocity' not in choose(topics())
    assert choose(topics(gps__vel=TWIST))['fix_velocity'] == '/gps/vel'
    assert 'fix_velocity' not in choose(topics(gps__vel=TWIST), gnss__use_velocity=False)
    # of two that of the node, else none
    assert choose(topics(gps__vel=TWIST, ublox__fix_velocity=TWIST))['fix_velocity'] == \
        '/ublox/fix_velocity'
    assert 'fix_velocity' not in choose(topics(gps__vel=TWIST, gnss__vel=TWIST))


@pytest.mark.parametrize('name', [
    'cmd_vel', 'vehicle__twist', 'vel', 'prefix__twist', 'gps__filtered_vel', 'fix_speed',
    'gps_car__wheel_twist', 'gnss__cmd_vel'])
def test_other_twists_are_taken_for_a_velocity_only_by_name(name):
    found, topic = topics(**{name: TWIST}), '/' + name.replace('__', '/')
    ask = {'odometer': '/odometer'}
    assert 'fix_velocity' not in choose(found, ask)
    assert choose(found, ask | {'fix_velocity': topic})['fix_velocity'] == topic


def test_heading():
    found = topics(heading=IMU)
    assert choose(found)['heading'] == '/heading'      # as the node, which tries it first
    assert choose(found)['imu'] == '/imu/data'
    assert 'heading' not in choose(found, alignment__heading_source='course')
    found = topics(gnss__heading_imu=IMU)
    assert choose(found, alignment__heading_source='heading_topic')['heading'] == \
        '/gnss/heading_imu'
    with pytest.raises(BadUsage, match='no heading'):
        choose(topics(imu__data=None, imu=IMU), {'imu': '/imu'},
               alignment__heading_source='heading_topic')
    with pytest.raises(BadUsage, match=r'^no heading \(a topic of sensor_msgs/msg/Imu besides '
                       r'the IMU\) in the bag; the bag has /imu/data'):
        choose(topics(), alignment__heading_source='heading_topic')      # the IMU is there
    assert choose(topics(other=IMU), {'heading': 'other'})['imu'] == '/imu/data'


def test_wheels_on_two_topics():
    sides = topics(odometer=None, ticks_left=INT, ticks_right=INT)
    two = {'odometer__left': 'topic', 'odometer__right': 'topic'}
    assert choose(sides, **two)['odometer'] == '/ticks_left'
    assert choose(sides, **two)['odometer_right'] == '/ticks_right'
    assert choose(topics(odometer_right=INT), **two)['odometer_right'] == '/odometer_right'
    assert choose(topics(a=INT), {'odometer': '/odometer', 'odometer_right': 'a'},
                  **two)['odometer_right'] == '/a'
    with pytest.raises(BadUsage, match='odometer.left and odometer.right to topic'):
        choose(sides)
    with pytest.raises(BadUsage, match='no right odometer'):
        choose(topics(), **two)


def test_the_journal_of_a_namespaced_node_is_found():
    found = {n: TopicInfo(n, t, 9) for n, t in {
        '/car/imu/data': IMU, '/car/odometer': INT, '/car/fix': FIX,
        '/car/calibrator/status': 'diagnostic_msgs/msg/DiagnosticArray'}.items()}
    assert choose(found) == {'odometer': '/car/odometer', 'imu': '/car/imu/data',
                             'fix': '/car/fix'}


POSE, POINT = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PointStamped'
ODOM = 'nav_msgs/msg/Odometry'


@pytest.mark.parametrize('kind', [
    POSE, POINT, 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'geometry_msgs/msg/TransformStamped'])
def test_a_pose_is_the_reference_where_there_is_no_fix(kind):
    found = topics(fix=None, slam__pose=kind)
    chosen = choose(found)
    assert chosen['fix'] == '/slam/pose'
    assert local_reference(found, chosen, {}) == (
        f'no NavSatFix with messages in the bag; position reference: /slam/pose ({kind}); another '
        'one: --fix-topic')
    assert local_reference(found, chosen, {'fix': '/slam/pose'}) == ''
    assert choose(topics(slam__pose=kind))['fix'] == '/fix'
    assert choose(topics(slam__pose=kind), {'fix': 'slam/pose'})['fix'] == '/slam/pose'
    unused = topics(slam__pose=kind) | {'/fix': TopicInfo('/fix', FIX, 0)}
    assert choose(unused)['fix'] == '/slam/pose'


def test_of_two_poses_the_user_selects():
    found = topics(fix=None, slam__pose=POSE, prism=POINT)
    with pytest.raises(BadUsage, match=r'^2 topics can be the fix; choose one with --fix-topic: '
                       r'/slam/pose \(geometry_msgs/msg/PoseStamped\), /prism \(geometry_msgs'):
        choose(found)
    assert choose(found, {'fix': '/prism'})['fix'] == '/prism'
    # goals and clicks are poses that a person sets
    more = topics(fix=None, slam__pose=POSE, goal_pose=POSE, clicked_point=POINT,
                  initialpose='geometry_msgs/msg/PoseWithCovarianceStamped')
    assert choose(more)['fix'] == '/slam/pose'


def test_tf_and_odometry_are_references_only_by_name():
    found = topics(fix=None, tf='tf2_msgs/msg/TFMessage')
    with pytest.raises(BadUsage, match='name a tf2_msgs/msg/TFMessage or nav_msgs/msg/Odometry '
                       'with --fix-topic'):
        choose(found)
    assert choose(found, {'fix': '/tf'})['fix'] == '/tf'
    found = topics(fix=None, lidar_odometry=ODOM)
    with pytest.raises(BadUsage, match=r'^no fix \(a topic of sensor_msgs/msg/NavSatFix, '
                       r'geometry_msgs/msg/PoseStamped, .*\) in the bag; name .*/Odometry '
                       'with --fix-topic; the bag has'):
        choose(found, {'odometer': '/odometer'})
    assert choose(found, {'fix': '/lidar_odometry'}) == {
        'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/lidar_odometry'}


def test_one_topic_is_not_odometer_and_reference():
    found = topics(fix=None, odometer=None, odom=ODOM)
    with pytest.raises(BadUsage, match='^/odom is both --odometer-topic and --fix-topic: an '
                       'odometer cannot be calibrated against itself'):
        choose(found, {'odometer': 'odom', 'fix': '/odom'})
    with pytest.raises(BadUsage, match=r'^no odometer in the bag besides /odom, which is the '
                       r'position reference \(--fix-topic\)'):
        choose(found, {'fix': '/odom'})
