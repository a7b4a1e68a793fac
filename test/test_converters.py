# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The converters of a CANedge session and of the Husky, on recordings made from bags."""

import dataclasses

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import get_typestore, Stores

from tools import canedge_bag, husky_bag
from tools.canedge_bag import HEIGHT, IMU, POSITION, REPLY, SIGNALS, SPEED

IMU_ROWS = 20_000          # of 286 219, for time
START = 1_627_305_219_000_000_000
TOPICS = {'/imu/data': '/imu/data', '/odom': '/husky_velocity_controller/odom', '/fix': '/gps/fix'}
POSITION_FIELDS = 'latitude', 'longitude', 'altitude'
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def frame(number, **signals):
    """Return the 8 bytes of each row of signals, in the layout of the data set."""
    bits = 0
    for name, value in signals.items():
        first, width, factor, offset = SIGNALS[number][name]
        raw = np.round((np.asarray(value) - offset) / factor).astype(np.uint64)
        assert (raw < 2**width).all()
        bits = bits | raw << np.uint64(first)
    return np.atleast_1d(bits).astype('<u8').view(np.uint8).reshape(-1, 8)


def merged_frames(parts):
    """Return stamps, identifiers and bytes of frames in their order."""
    stamp, ids, data = (np.concatenate(column) for column in zip(*(
        (stamp, np.full(len(stamp), number), data) for number, stamp, data in parts), strict=True))
    order = np.argsort(stamp, kind='stable')
    return stamp[order], ids[order], data[order]


def reply(km_per_hour):
    """Return replies of the engine to a request of the speed."""
    data = np.zeros((len(km_per_hour), 8), np.uint8)
    data[:, :3], data[:, 3] = [3, 0x41, 0x0D], km_per_hour
    return data


@pytest.fixture
def session():
    """Return frames of four seconds, with a reply that is not a speed and an invalid fix."""
    whole = START + np.arange(4) * 10**9
    other = reply([1, 2])
    other[:, 2] = 0x0C
    return merged_frames([
        (IMU, whole, frame(IMU, fx=[9.5, 9.625, 0, 0], fy=[-0.625, 0, 0, 0], fz=[1.0, 0, 0, 0],
                           wx=[6.75, 0, 0, 0], wy=[0, -0.25, 0, 0], wz=[0.25, 0, 0, 0])),
        (REPLY, whole + 5, reply([0, 36, 36, 72])), (REPLY, whole[:2] + 7, other),
        (SPEED, whole, frame(SPEED, speed=[0.015, 10.0, 10.001, 20.0])),
        (HEIGHT, whole[:2], frame(HEIGHT, height=[79.9, 80.0], accuracy=[2, 3])),
        (POSITION, whole[1:], frame(POSITION, valid=[1, 0, 1], latitude=[55.87, 55.9, -33.0],
                                    longitude=[9.86, 9.9, -71.0], accuracy=[1, 1, 7]))])


def test_signals_have_the_layout_of_the_data_set(session):
    imu, twist, pulses, speed, fix = (topic.pack(slice(None))
                                      for topic in canedge_bag.topics(*session))
    np.testing.assert_array_equal(imu['linear_acceleration'][:2],
                                  [[9.5, -0.625, 1.0], [9.625, 0.0, 0.0]])
    np.testing.assert_allclose(np.rad2deg(imu['angular_velocity'][:2]),
                               [[6.75, 0, 0.25], [0, -0.25, 0]])
    np.testing.assert_allclose(twist['twist.linear.x'], [0, 10, 10, 20])
    np.testing.assert_array_equal(pulses['data'], [0, 50, 150, 300])     # 5, 10 and 15 m
    np.testing.assert_allclose(speed['twist.linear.x'], [0.015, 10.0, 10.001, 20.0])
    np.testing.assert_allclose([fix[name] for name in POSITION_FIELDS],
                               [(55.87, -33.0), (9.86, -71.0), (80.0, 80.0)])
    np.testing.assert_allclose(fix['position_covariance'][:, [0, 4, 8]],
                               [[0.5, 0.5, 9], [24.5, 24.5, 9]])


def test_a_drive_converted_to_frames_and_back_is_unchanged(data_dir):
    """The bag of the recording as frames, and these as a bag: the same messages."""
    stored, messages = {}, {}
    with AnyReader([data_dir / 'canedge_car_165' / 'bag']) as bag:
        for link, stamp, raw in bag.messages():
            if link.topic == '/imu/data' and len(stored.get(link.topic, ())) == IMU_ROWS:
                continue
            stored.setdefault(link.topic, []).append((stamp, bytes(raw)))
            messages.setdefault(link.topic, []).append(bag.deserialize(raw, link.msgtype))
    stamp = {topic: np.array([s for s, _ in rows]) for topic, rows in stored.items()}
    imu, fix, speed = (messages[topic] for topic in ('/imu/data', '/fix', '/fix_speed'))
    turn, force = (np.array([[getattr(getattr(m, field), axis) for axis in 'xyz'] for m in imu])
                   for field in ('angular_velocity', 'linear_acceleration'))
    variance = np.array([m.position_covariance[[0, 8]] for m in fix])
    parts = [
        (IMU, stamp['/imu/data'], frame(
            IMU, **{f'w{a}': np.rad2deg(turn[:, n]) for n, a in enumerate('xyz')},
            **{f'f{a}': force[:, n] for n, a in enumerate('xyz')})),
        (REPLY, stamp['/vehicle/twist'], reply(
            np.round([m.twist.linear.x * 3.6 for m in messages['/vehicle/twist']]))),
        (SPEED, stamp['/fix_speed'], frame(SPEED, speed=[m.twist.linear.x for m in speed])),
        (HEIGHT, stamp['/fix'], frame(
            HEIGHT, height=[m.altitude for m in fix], accuracy=np.sqrt(variance[:, 1]))),
        (POSITION, stamp['/fix'], frame(
            POSITION, valid=[1] * len(fix), latitude=[m.latitude for m in fix],
            longitude=[m.longitude for m in fix], accuracy=np.sqrt(2 * variance[:, 0])))]
    for topic in canedge_bag.topics(*merged_frames(parts)):
        found = topic.pack(slice(None))
        np.testing.assert_array_equal(topic.time_ns, stamp[topic.name])
        expected = np.frombuffer(bytearray().join(raw for _, raw in stored[topic.name]),
                                 found.dtype)
        # radians and degrees in between
        for name in POSITION_FIELDS if topic.name == '/fix' else ():
            np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-12)
            expected[name] = found[name]
        assert found.tobytes() == expected.tobytes(), topic.name


def as_ros1(message, kind):
    values = {}
    for field in dataclasses.fields(ROS1.types[kind]):
        if not field.init or field.name == '__msgtype__':
            continue
        value = 0 if field.name == 'seq' else getattr(message, field.name)
        inner = getattr(value, '__msgtype__', None)
        values[field.name] = as_ros1(value, inner) if inner in ROS1.types else value
    return ROS1.types[kind](**values)


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


def test_the_recording_of_the_husky_is_converted_without_loss(recording, tmp_path):
    path, source = recording
    assert husky_bag.main([str(path), '--out', str(tmp_path)]) == 0
    with AnyReader([source]) as bag, AnyReader([tmp_path / 'bag']) as converted:
        for topic in converted.topics:
            expected, found = (
                [(arrival, reader.deserialize(raw, link.msgtype)) for link, arrival, raw
                 in reader.messages([c for c in reader.connections if c.topic == topic])]
                for reader in (bag, converted))
            assert [arrival for arrival, _ in found] == [arrival for arrival, _ in expected], topic
            for (_, a), (_, b) in zip(found, expected, strict=True):
                same(topic, a, b)


def same(topic, found, expected):
    """Compare the fields of two messages that a calibration uses."""
    if topic == '/odometer/pulses_derived':
        assert abs(found.data - expected.data) <= 1          # a rounding
    elif topic == '/vehicle/twist':
        assert found.twist.linear.x == expected.twist.linear.x
    elif topic == '/fix':
        np.testing.assert_allclose(
            [found.latitude, found.longitude, found.altitude],
            [expected.latitude, expected.longitude, expected.altitude], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found.position_covariance, expected.position_covariance)
        assert found.status.status == expected.status.status
    else:
        for field in ('angular_velocity', 'linear_acceleration'):
            np.testing.assert_array_equal(*(husky_bag.vectors([one], field)
                                            for one in (found, expected)))


def test_a_file_other_than_the_recording_is_refused(tmp_path, capsys):
    (tmp_path / 'other.bag').write_bytes(b'nothing')
    assert husky_bag.main([str(tmp_path / 'other.bag'), '--out', str(tmp_path / 'out')]) == 2
    assert 'husky_bag: ' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
