# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""GPSFix of gps_msgs and gps_common: read as the NavSatFix with the same position."""

import dataclasses
import math

import numpy as np
import pytest
import ros_bags
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from odocal_ros.bagio.read import open_bag, TopicInfo
from odocal_ros.data.leg import LegRecorder
from odocal_ros.library.topics import choose_topics
from odocal_ros.messages.decode import make_reader
from odocal_ros.settings.config import Config

STATUS = """
std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
NUMBERS = ('track', 'speed', 'climb', 'pitch', 'roll', 'dip', 'time', 'gdop', 'pdop', 'hdop',
           'vdop', 'tdop', 'err', 'err_horz', 'err_vert', 'err_track', 'err_speed', 'err_climb',
           'err_time', 'err_pitch', 'err_roll', 'err_dip')
GPS_FIX = '\n'.join(('std_msgs/Header header', 'GPSStatus status', 'float64 latitude',
                     'float64 longitude', 'float64 altitude',
                     *(f'float64 {name}' for name in NUMBERS), 'float64[9] position_covariance',
                     'uint8 position_covariance_type'))
# satellites of each message, GPSFix status, NavSatFix status
CASES = ((0, -1, -1), (3, 0, 0), (12, 33, 1), (12, 18, 2), (12, 19, 2), (7, 20, 2), (0, 2, 2))


def store_of(package):
    store = get_typestore(Stores.ROS2_JAZZY)
    types = get_types_from_msg(STATUS, f'{package}/msg/GPSStatus')
    types |= get_types_from_msg(GPS_FIX, f'{package}/msg/GPSFix')
    store.register(types)
    return store


def message(store, package, k):
    """Return the k-th message; its other numbers differ from the position."""
    satellites, status, _ = CASES[k]
    time = store.types['builtin_interfaces/msg/Time'](sec=100 + k, nanosec=7)
    header = store.types['std_msgs/msg/Header'](stamp=time, frame_id='gps'[:k])
    listed = np.arange(satellites, dtype=np.int32)
    of_status = store.types[f'{package}/msg/GPSStatus'](
        header=header, satellites_used=satellites, satellite_used_prn=listed,
        satellites_visible=satellites, satellite_visible_prn=listed, satellite_visible_z=listed,
        satellite_visible_azimuth=listed, satellite_visible_snr=listed, status=status,
        motion_source=1, orientation_source=2, position_source=4)
    return store.types[f'{package}/msg/GPSFix'](
        header=header, status=of_status, latitude=48.0 + k, longitude=-11.0 - k,
        altitude=500.0 + k, **{name: 1e3 + n for n, name in enumerate(NUMBERS)},
        position_covariance=np.arange(9.0) + k, position_covariance_type=k % 4)


@pytest.mark.parametrize('package', ['gps_msgs', 'gps_common'])
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_gpsfix_messages_of_both_packages_are_read_from_a_bag(tmp_path, package, storage):
    store, name = store_of(package), f'{package}/msg/GPSFix'
    rows = [('/gps', k, bytes(store.serialize_cdr(message(store, package, k), name)))
            for k in range(len(CASES))]
    path = ros_bags.write(tmp_path / 'bag', rows, storage, types={'/gps': name}, store=store)
    recorder = LegRecorder()
    with open_bag(path) as bag:
        reader = make_reader('fix', bag.topics['/gps'].msgtype, Config())
        bag.read({'/gps': reader}, recorder.feed)
    fix, k = recorder.rows('fix'), np.arange(len(CASES))
    assert reader.unreadable == 0
    assert fix.stamp_ns.tolist() == [(100 + i) * 10**9 + 7 for i in k.tolist()]
    assert fix.latitude == pytest.approx((48.0 + k) * math.pi / 180)
    assert fix.longitude == pytest.approx((-11.0 - k) * math.pi / 180)
    assert fix.height.tolist() == (500.0 + k).tolist()
    assert fix.covariance_n.reshape(-1, 9).tolist() == [
        (np.arange(9.0) + i).tolist() for i in k.tolist()]
    assert fix.covariance_type.tolist() == (k % 4).tolist()
    assert fix.status.tolist() == [status for _, _, status in CASES]


def test_a_block_and_single_gpsfix_messages_give_the_same_rows():
    store, name = store_of('gps_msgs'), 'gps_msgs/msg/GPSFix'
    raws = [bytes(store.serialize_cdr(message(store, 'gps_msgs', k), name))
            for k in range(len(CASES))]
    big = [bytes(store.serialize_cdr(message(store, 'gps_msgs', k), name, little_endian=False))
           for k in range(len(CASES))]      # without a layout
    blocks = [make_reader('fix', name, Config()).rows(
        sent, range(len(sent)), lambda raw: store.deserialize_cdr(raw, name))[0][1]
        for sent in (raws * 20, big * 20)]
    for field in dataclasses.fields(blocks[0]):
        one, other = (getattr(block, field.name) for block in blocks)
        assert np.array_equal(one, other), field.name


def test_navsatfix_takes_precedence_over_gpsfix_and_gpsfix_over_poses():
    base = {'/imu': 'sensor_msgs/msg/Imu', '/ticks': 'std_msgs/msg/Int64',
            '/gps': 'gps_msgs/msg/GPSFix', '/slam': 'geometry_msgs/msg/PoseStamped'}
    for more, expected in (({}, '/gps'), ({'/fix': 'sensor_msgs/msg/NavSatFix'}, '/fix')):
        topics = {name: TopicInfo(name, kind, 5) for name, kind in (base | more).items()}
        assert choose_topics(topics, Config(), {})['fix'] == expected
