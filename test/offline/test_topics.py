# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Topics by message type: one candidate is used, several or none give an error with the remedy."""

import pytest

from odocal_ros.bagio.read import TopicInfo
from odocal_ros.errors import BadUsage
from odocal_ros.library.topics import choose_topics, reference_note
from odocal_ros.offline.suggest import likely_mapping
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
IMU, FIX = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/NavSatFix'
INT, TWIST = 'std_msgs/msg/Int64', 'geometry_msgs/msg/TwistStamped'
BASE = {'/imu/data': IMU, '/odometer': INT, '/fix': FIX}
ODD = {'/rosout': 'rcl_interfaces/msg/Log', '/cmd_vel': 'geometry_msgs/msg/Twist',
       '/calibrator/odometer': INT, '/tf': 'tf2_msgs/msg/TFMessage'}


POSE, POINT = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PointStamped'
ODOM = 'nav_msgs/msg/Odometry'
BY_TOPIC = {'alignment__heading_source': 'heading_topic'}
TWO = {'odometer__left': 'topic', 'odometer__right': 'topic'}


def topics(**types):
    """Return the base topics and more; __ in a name is a slash; None removes a topic."""
    named = BASE | {'/' + name.replace('__', '/'): t for name, t in types.items()}
    return {n: TopicInfo(n, t, 5) for n, t in named.items() if t}


SIDES = topics(odometer=None, ticks_left=INT, ticks_right=INT)


def choose(found, overrides=None, **settings):
    config = with_settings(Config(), {k.replace('__', '.'): v for k, v in settings.items()})
    return choose_topics(found, config, overrides or {})


def test_one_topic_of_each_type_is_used_also_in_a_namespace():
    expected = {'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/fix'}
    assert choose(topics()) == expected
    assert choose(topics() | {n: TopicInfo(n, t, 5) for n, t in ODD.items()}) == expected
    # a topic without messages is not a candidate
    assert choose(topics() | {'/imu/raw': TopicInfo('/imu/raw', IMU, 0)}) == expected
    found = {n: TopicInfo(n, t, 9) for n, t in {
        '/car/imu/data': IMU, '/car/odometer': INT, '/car/fix': FIX,
        '/car/calibrator/status': 'diagnostic_msgs/msg/DiagnosticArray'}.items()}
    assert choose(found) == {'odometer': '/car/odometer', 'imu': '/car/imu/data',
                             'fix': '/car/fix'}


@pytest.mark.parametrize(('found', 'overrides', 'settings', 'match'), [
    (topics(speed=TWIST, wheels='sensor_msgs/msg/JointState'), {}, {},
     r'3 topics can be the odometer; choose one with --odometer-topic:\n  /odometer '
     r'\(std_msgs/msg/Int64\),\n  /speed'),
    (topics(imu__raw=IMU, phone=FIX), {}, {},       # all errors
     r'can be the IMU.*--imu-topic:(?s:.*)\);\n2 topics can be the fix.*--fix-topic'),
    (topics(imu__data=None), {}, {}, r'no IMU \(a topic of sensor_msgs/msg/Imu\) in the bag;\n'
     r'the bag has:\n  /odometer \(std_msgs/msg/Int64\),\n  /fix'),
    (topics(), {'heading': '/imu/data'}, {},
     r'no IMU \(a topic of sensor_msgs/msg/Imu besides /imu/data\) in the bag'),
    (topics(), {'fix': '/gps'}, {}, '--fix-topic /gps: no such topic; the bag has:\n  /imu/data'),
    # the error does not report the other topics as missing
    (topics(), {'imu': '/fix'}, {}, '^--imu-topic /fix: the topic is of sensor_msgs/msg/NavSatFix'
     ', which cannot be used as IMU; the bag has:\n  /imu/data'),
    *((topics(), {slot: topic}, {}, 'which cannot be used as ') for slot, topic in (
        ('odometer', '/imu/data'), ('odometer_right', '/fix'), ('fix', '/odometer'),
        ('heading', '/fix'), ('fix_velocity', '/odometer'))),
    (topics() | {'/gps': TopicInfo('/gps', FIX, 0)}, {'fix': '/gps'}, {},
     'the topic has no message'),
    (topics(), {}, {'odometer__type': 'my_msgs/msg/Ticks'}, 'no odometer'),
    (topics(odometer=None, cmd_vel='geometry_msgs/msg/Twist'), {}, {}, 'no odometer'),
    (topics(imu__data=None, imu=IMU), {'imu': '/imu'}, BY_TOPIC, 'no heading'),
    (topics(), {}, BY_TOPIC, r'^no heading \(a topic of sensor_msgs/msg/Imu besides the IMU\) in '
     'the bag;\nthe bag has:\n  /imu/data'),      # the IMU is listed
    (SIDES, {}, {}, 'odometer.left and odometer.right to topic'),
    (topics(), {}, TWO, 'no right odometer'),
    (topics(fix=None, slam__pose=POSE, prism=POINT), {}, {},
     r'^2 topics can be the fix; choose one with --fix-topic:\n  /slam/pose '
     r'\(geometry_msgs/msg/PoseStamped\),\n  /prism \(geometry_msgs'),
    (topics(fix=None, tf='tf2_msgs/msg/TFMessage'), {}, {},
     'name a tf2_msgs/msg/TFMessage or nav_msgs/msg/Odometry with --fix-topic'),
    (topics(fix=None, lidar_odometry=ODOM), {'odometer': '/odometer'}, {},
     r'^no fix \(a topic of sensor_msgs/msg/NavSatFix, gps_msgs/msg/GPSFix, .*'
     r'geometry_msgs/msg/PoseStamped, .*\) in the bag; name .*/Odometry with --fix-topic;\n'
     'the bag has:'),
    (topics(fix=None, odometer=None, odom=ODOM), {'odometer': 'odom', 'fix': '/odom'}, {},
     '^/odom is both --odometer-topic and --fix-topic: an odometer cannot be calibrated against '
     'itself'),
    (topics(fix=None, odometer=None, odom=ODOM), {'fix': '/odom'}, {},
     r'^no odometer in the bag besides /odom, which is the position reference \(--fix-topic\)')])
def test_ambiguous_or_missing_topics_are_reported(found, overrides, settings, match):
    with pytest.raises(BadUsage, match=match):
        choose(found, overrides, **settings)


@pytest.mark.parametrize(('found', 'overrides', 'settings', 'expected'), [
    (topics(speed=TWIST), {'odometer': 'speed'}, {}, '/speed'),
    (topics(speed=TWIST), {}, {'odometer__type': TWIST}, '/speed'),
    (topics(odometry__filtered=ODOM), {}, {}, '/odometer'),
    (topics(ticks='my_msgs/msg/Ticks'), {'odometer': '/ticks'}, {}, '/ticks'),
    # a fused odometer is better than none
    (topics(odometer=None, localization__fused=ODOM), {}, {}, '/localization/fused'),
    (SIDES, {}, TWO, '/ticks_left')])
def test_the_odometer_is_chosen_by_name_type_and_setting(found, overrides, settings, expected):
    assert choose(found, overrides, **settings)['odometer'] == expected


@pytest.mark.parametrize(('found', 'overrides', 'expected'), [
    (SIDES, {}, '/ticks_right'), (topics(odometer_right=INT), {}, '/odometer_right'),
    (topics(a=INT), {'odometer': '/odometer', 'odometer_right': 'a'}, '/a')])
def test_the_right_wheel_has_its_own_topic(found, overrides, expected):
    assert choose(found, overrides, **TWO)['odometer_right'] == expected


def test_fixes_are_not_needed_when_the_ends_are_surveyed():
    found = choose(topics(fix=None), reference__start=[48.0, 11.0, 500.0, 0.01],
                   reference__end=[48.1, 11.0, 500.0, 0.01])
    assert 'fix' not in found


def test_a_velocity_is_used_if_its_name_is_that_of_a_receiver():
    assert 'fix_velocity' not in choose(topics())
    assert choose(topics(gps__vel=TWIST))['fix_velocity'] == '/gps/vel'
    assert 'fix_velocity' not in choose(topics(gps__vel=TWIST), gnss__use_velocity=False)
    # of two, the one with the name of the node, else none
    assert choose(topics(gps__vel=TWIST, ublox__fix_velocity=TWIST))['fix_velocity'] == \
        '/ublox/fix_velocity'
    assert 'fix_velocity' not in choose(topics(gps__vel=TWIST, gnss__vel=TWIST))


@pytest.mark.parametrize('name', [
    'cmd_vel', 'vehicle__twist', 'vel', 'prefix__twist', 'gps__filtered_vel', 'fix_speed',
    'gps_car__wheel_twist', 'gnss__cmd_vel'])
def test_other_twists_are_used_as_velocity_only_if_the_user_names_them(name):
    found, topic = topics(**{name: TWIST}), '/' + name.replace('__', '/')
    ask = {'odometer': '/odometer'}
    assert 'fix_velocity' not in choose(found, ask)
    assert choose(found, ask | {'fix_velocity': topic})['fix_velocity'] == topic


def test_the_heading_topic_is_chosen_by_its_name():
    found = topics(heading=IMU)
    assert choose(found)['heading'] == '/heading'      # as the node does
    assert choose(found)['imu'] == '/imu/data'
    assert 'heading' not in choose(found, alignment__heading_source='course')
    found = topics(gnss__heading_imu=IMU)
    assert choose(found, **BY_TOPIC)['heading'] == '/gnss/heading_imu'
    assert choose(topics(other=IMU), {'heading': 'other'})['imu'] == '/imu/data'


@pytest.mark.parametrize('kind', [
    POSE, POINT, 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'geometry_msgs/msg/TransformStamped'])
def test_a_pose_is_the_reference_where_there_is_no_fix(kind):
    found = topics(fix=None, slam__pose=kind)
    chosen = choose(found)
    assert chosen['fix'] == '/slam/pose'
    assert reference_note(found, chosen, {}) == (
        f'no NavSatFix with messages in the bag; position reference: /slam/pose ({kind}); another '
        'one: --fix-topic')
    assert reference_note(found, chosen, {'fix': '/slam/pose'}) == ''
    assert choose(topics(slam__pose=kind))['fix'] == '/fix'
    assert choose(topics(slam__pose=kind), {'fix': 'slam/pose'})['fix'] == '/slam/pose'
    unused = topics(slam__pose=kind) | {'/fix': TopicInfo('/fix', FIX, 0)}
    assert choose(unused)['fix'] == '/slam/pose'


def test_a_named_reference_is_used_and_goals_are_not_references():
    poses = topics(fix=None, slam__pose=POSE, prism=POINT)
    assert choose(poses, {'fix': '/prism'})['fix'] == '/prism'
    # goals and clicks are poses that a person sets
    more = topics(fix=None, slam__pose=POSE, goal_pose=POSE, clicked_point=POINT,
                  initialpose='geometry_msgs/msg/PoseWithCovarianceStamped')
    assert choose(more)['fix'] == '/slam/pose'
    assert choose(topics(fix=None, tf='tf2_msgs/msg/TFMessage'), {'fix': '/tf'})['fix'] == '/tf'
    assert choose(topics(fix=None, lidar_odometry=ODOM), {'fix': '/lidar_odometry'}) == {
        'imu': '/imu/data', 'odometer': '/odometer', 'fix': '/lidar_odometry'}


VELOCITY = 'autoware_vehicle_msgs/msg/VelocityReport'
JOINTS = 'sensor_msgs/msg/JointState'


@pytest.mark.parametrize(('right', 'wrong'), [
    ({'/vehicle/status/velocity_status': VELOCITY}, {'/localization/kinematic_state': ODOM}),
    ({'/vehicle/status/velocity_status': VELOCITY.replace('autoware', 'autoware_auto')},
     {'/localization/kinematic_state': ODOM}),
    ({'/wheel/odom': ODOM}, {'/zed/zed_node/odom': ODOM}),
    ({'/mavros/wheel_odometry/odom': ODOM}, {'/mavros/local_position/odom': ODOM}),
    ({'/odom': ODOM}, {'/lio_sam/mapping/odometry_incremental': ODOM}),
    ({'/odom': ODOM}, {'/camera/odom/sample': ODOM}),
    ({'/wheel/odometry': ODOM}, {'/odometry/local': ODOM, '/odometry/filtered': ODOM}),
    ({'/vehicle/odometry': ODOM}, {'/ins/odometry': ODOM}),
    ({'/wheel_encoder': INT}, {'/applanix/odom': ODOM}),
    ({'/base/joint_states': JOINTS}, {'/arm/joint_states': JOINTS}),
    ({'/instrument_cluster/speed': TWIST}, {'/reference/velocity': TWIST})])
def test_wheels_are_preferred_to_estimates_at_higher_rates(right, wrong):
    found = {n: TopicInfo(n, t, 5) for n, t in (BASE | right).items() if n != '/odometer'} | {
        n: TopicInfo(n, t, 500) for n, t in wrong.items()}
    assert likely_mapping(found, Config(), {})[0]['odometer'] == next(iter(right))


@pytest.mark.parametrize(('raw', 'fused'), [
    ('/gnss_1/llh_position', '/ekf/llh_position'),
    ('/fixposition/gnss1', '/fixposition/odometry_llh'),
    ('/gps/fix', '/gps/filtered'), ('/gnss', '/ins/fix')])
def test_positions_of_a_receiver_are_preferred_to_those_of_a_filter(raw, fused):
    found = {n: TopicInfo(n, t, 5) for n, t in BASE.items() if n != '/fix'} | {
        raw: TopicInfo(raw, FIX, 5), fused: TopicInfo(fused, FIX, 500)}
    assert choose(found)['fix'] == raw
    assert choose({n: t for n, t in found.items() if n != raw})['fix'] == fused


@pytest.mark.parametrize('names', [('/encoders/left', '/encoders/right'),
                                   ('/left_wheel/rpm', '/right_wheel/rpm')])
def test_left_and_right_topics_are_chosen_as_a_pair_among_others(names):
    kind = 'std_msgs/msg/Float64'
    found = {n: TopicInfo(n, t, 5) for n, t in (
        BASE | dict.fromkeys((*names, '/motor_current/left'), kind) | {'/odom': ODOM}).items()
        if n != '/odometer'}
    mapping, config = likely_mapping(found, Config(), {})
    assert (mapping['odometer'], mapping['odometer_right']) == names
    assert config.odometer.left == config.odometer.right == 'topic'


@pytest.mark.parametrize(('own', 'other'), [
    ('/vectornav/imu', '/zed/zed_node/imu/data'), ('/imu', '/oak/imu/data'),
    ('/mti/imu', '/os_cloud_node/imu'), ('/imu/data_raw', '/realsense/imu')])
def test_an_imu_of_its_own_is_preferred_to_one_with_the_usual_name_in_a_camera(own, other):
    found = {n: TopicInfo(n, t, 5) for n, t in BASE.items() if n != '/imu/data'} | {
        own: TopicInfo(own, IMU, 5), other: TopicInfo(other, IMU, 500)}
    assert likely_mapping(found, Config(), {})[0]['imu'] == own


def test_imus_of_cameras_and_lidars_come_last():
    found = {n: TopicInfo(n, t, count) for n, t, count in (
        ('/zed/zed_node/imu/data', IMU, 400), ('/livox/imu', IMU, 200),
        ('/xsens/imu/data', IMU, 100), ('/odometer', INT, 5), ('/fix', FIX, 5),
        ('/gps_rtk/fix', FIX, 1))}
    mapping, _ = likely_mapping(found, Config(), {})
    assert (mapping['imu'], mapping['fix']) == ('/xsens/imu/data', '/gps_rtk/fix')
