# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The converter of the Husky's recording, on a rosbag1 made back from its bag."""

import dataclasses

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import get_typestore, Stores

from tools import husky_bag

TOPICS = {'/imu/data': '/imu/data', '/odom': '/husky_velocity_controller/odom', '/fix': '/gps/fix'}
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def as_ros1(message, kind):
    made = {}
    for field in dataclasses.fields(ROS1.types[kind]):
        if not field.init or field.name == '__msgtype__':
            continue
        value = 0 if field.name == 'seq' else getattr(message, field.name)
        inner = getattr(value, '__msgtype__', None)
        made[field.name] = as_ros1(value, inner) if inner in ROS1.types else value
    return ROS1.types[kind](**made)


@pytest.fixture(scope='module')
def recording(data_dir, tmp_path_factory):
    """Return a rosbag1 with the names of the download, and the bag it is from."""
    source = data_dir / 'husky_parking_lot' / 'bag'
    path = tmp_path_factory.mktemp('husky') / 'test1.bag'
    with AnyReader([source]) as bag, Writer(path) as writer:
        links = {}
        for link, arrival, raw in bag.messages([c for c in bag.connections if c.topic in TOPICS]):
            if link.topic not in links:
                links[link.topic] = writer.add_connection(TOPICS[link.topic], link.msgtype,
                                                          typestore=ROS1)
            message = as_ros1(bag.deserialize(raw, link.msgtype), link.msgtype)
            writer.write(links[link.topic], arrival, ROS1.serialize_ros1(message, link.msgtype))
    return path, source


def test_the_recorded_drive_comes_back(recording, tmp_path):
    path, source = recording
    assert husky_bag.main([str(path), '--out', str(tmp_path)]) == 0
    with AnyReader([source]) as bag, AnyReader([tmp_path / 'bag']) as made:
        for topic in made.topics:
            wanted, found = ([(arrival, one.deserialize(raw, link.msgtype)) for link, arrival, raw
                              in one.messages([c for c in one.connections if c.topic == topic])]
                             for one in (bag, made))
            assert [arrival for arrival, _ in found] == [arrival for arrival, _ in wanted], topic
            for (_, a), (_, b) in zip(found, wanted, strict=True):
                same(topic, a, b)


def same(topic, found, wanted):
    """Compare what a calibration uses of two messages."""
    if topic == '/odometer/pulses_derived':
        assert abs(found.data - wanted.data) <= 1          # a rounding
    elif topic == '/vehicle/twist':
        assert found.twist.linear.x == wanted.twist.linear.x
    elif topic == '/fix':
        np.testing.assert_allclose(
            [found.latitude, found.longitude, found.altitude],
            [wanted.latitude, wanted.longitude, wanted.altitude], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found.position_covariance, wanted.position_covariance)
        assert found.status.status == wanted.status.status
    else:
        for field in ('angular_velocity', 'linear_acceleration'):
            np.testing.assert_array_equal(*(husky_bag.vectors([one], field)
                                            for one in (found, wanted)))


def test_a_file_that_is_not_the_recording_is_refused(tmp_path, capsys):
    (tmp_path / 'other.bag').write_bytes(b'nothing')
    assert husky_bag.main([str(tmp_path / 'other.bag'), '--out', str(tmp_path / 'out')]) == 2
    assert 'husky_bag: ' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
