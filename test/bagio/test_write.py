# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Written bags are read back by rosbags, value for value."""

import sqlite3

import numpy as np
import pytest

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.data.samples import HeadingSamples, OdometerSamples
from odocal_ros.errors import BadUsage
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
SHORT = {'scenario': 'town', 'duration': 140.0, 'imu_rate': 50.0}


@pytest.fixture(scope='module')
def drive():
    return simulate(SimOptions(**SHORT, orientation_sigma=0.02, heading_sigma=0.01,
                               velocity_sigma=0.05))


def messages(path):
    """Return {topic: [(bag time, message)]} and the topics in order of the file."""
    from rosbags.highlevel import AnyReader
    found, order = {}, []
    with AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, message))
            order.append(time_ns)
    assert order == sorted(order)
    return found


def header_ns(rows):
    return [m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for _, m in rows]


def xyz(v):
    return [v.x, v.y, v.z]


@pytest.mark.parametrize(('storage', 'compression'), [
    ('mcap', 'none'), ('mcap', 'message'), ('mcap', 'file'), ('mcap', 'storage'),
    ('sqlite3', 'none'), ('sqlite3', 'message'), ('sqlite3', 'file'), ('rosbag1', 'none')])
def test_a_written_drive_is_read_back_value_for_value(tmp_path, drive, storage, compression):
    path = tmp_path / ('drive.bag' if storage == 'rosbag1' else 'drive')
    assert write_bag(path, drive_topics(drive), storage, compression) == path
    back = messages(path)
    assert sorted(back) == ['/fix', '/fix_velocity', '/heading', '/imu/data', '/odometer']
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name]   # no left-overs
    imu, odometer = back['/imu/data'], back['/odometer']
    same(imu, drive.imu, w_i=lambda m: xyz(m.angular_velocity),
         f_i=lambda m: xyz(m.linear_acceleration), q_ni=attitude,
         yaw_variance=lambda m: m.orientation_covariance[8])
    assert [t for t, _ in imu] == drive.imu.received_ns.tolist()
    assert {m.header.frame_id for _, m in imu} == {'imu_link'}
    assert [t for t, _ in odometer] == drive.odometer.stamp_ns.tolist()
    assert [m.data for _, m in odometer] == drive.odometer.value.tolist()
    same_fixes(back['/fix'], drive.fix)
    same(back['/fix_velocity'], drive.velocity, velocity_n=lambda m: xyz(m.twist.twist.linear),
         variance_n=lambda m: m.twist.covariance[:15:7])
    same(back['/heading'], drive.heading, q_ni=attitude)
    assert all(m.angular_velocity_covariance[0] == -1 for _, m in back['/heading'])


def attitude(message):
    return [*xyz(message.orientation), message.orientation.w]


def same(rows, samples, **columns):
    """Check messages against samples: stamps, and each column by a function of a message."""
    assert header_ns(rows) == samples.stamp_ns.tolist()
    for name, value in columns.items():
        assert np.array_equal([value(m) for _, m in rows], getattr(samples, name)), name


def same_fixes(rows, fixes):
    same(rows, fixes, height=lambda m: m.altitude, status=lambda m: m.status.status,
         covariance_n=lambda m: m.position_covariance.reshape(3, 3),
         covariance_type=lambda m: m.position_covariance_type)
    for name in ('latitude', 'longitude'):
        # one rounding to degrees and one back: two units in the last place of 1 rad
        np.testing.assert_allclose(np.radians([getattr(m, name) for _, m in rows]),
                                   getattr(fixes, name), rtol=4.5e-16)


def test_a_missing_orientation_is_marked_as_in_rep_145(tmp_path):
    drive = simulate(SimOptions(**SHORT))
    back = messages(write_bag(tmp_path / 'drive', drive_topics(drive)))
    assert {m.orientation_covariance[0] for _, m in back['/imu/data']} == {-1.0}


@pytest.mark.parametrize('frame', ['', 'a', 'ab', 'abc', 'imu_link', 'a_rather_long_frame_name'])
def test_frames_of_every_length_are_padded_correctly(tmp_path, drive, frame):
    topics = [encode.imu('/imu', drive.imu, frame), encode.fix('/fix', drive.fix, frame),
              encode.twist('/speed', drive.odometer, frame),
              encode.joints('/joints', {'l': drive.odometer, 'right': drive.odometer}, frame)]
    back = messages(write_bag(tmp_path / 'bag', topics))
    assert {m.header.frame_id for t in ('/imu', '/fix', '/speed', '/joints')
            for _, m in back[t]} == {frame}
    assert xyz(back['/imu'][5][1].linear_acceleration) == drive.imu.f_i[5].tolist()
    same_fixes(back['/fix'], drive.fix)
    value = drive.odometer.value
    assert [m.twist.linear.x for _, m in back['/speed']] == value.tolist()
    joints = [m for _, m in back['/joints']]
    assert joints[-1].name == ['l', 'right']
    assert joints[-1].position.tolist() == [value[-1], value[-1]]
    assert len(joints[-1].velocity) == len(joints[-1].effort) == 0


@pytest.mark.parametrize(('odometer', 'topics'), [
    ('counts', ['/fix', '/imu/data', '/odometer/left', '/odometer/right']),
    ('angle', ['/fix', '/imu/data', '/joint_states'])])
def test_two_wheels_have_two_counters_or_two_joints(tmp_path, odometer, topics):
    drive = simulate(SimOptions(**SHORT, odometer=odometer, two_wheels=True))
    back = messages(write_bag(tmp_path / 'drive', drive_topics(drive)))
    assert sorted(back) == topics
    if odometer == 'angle':
        position = np.array([m.position for _, m in back['/joint_states']])
        assert np.array_equal(position[:, 0], drive.odometer.value)
        assert np.array_equal(position[:, 1], drive.odometer_right.value)
    else:
        assert [m.data for _, m in back['/odometer/right']] == drive.odometer_right.value.tolist()


def test_the_block_size_does_not_change_the_bag(tmp_path, drive, monkeypatch):
    whole = messages(write_bag(tmp_path / 'whole', drive_topics(drive), 'sqlite3'))
    monkeypatch.setattr('odocal_ros.bagio.write.BLOCK_MESSAGES', 7)
    reported = []
    write_bag(tmp_path / 'parts', drive_topics(drive), 'sqlite3', progress=reported.append)
    assert reported == sorted(reported)
    assert reported[-1] == 1.0
    rows = [sqlite3.connect(tmp_path / name / f'{name}.db3').execute(
        'SELECT topic_id, timestamp, data FROM messages ORDER BY id').fetchall()
        for name in ('whole', 'parts')]
    assert rows[0] == rows[1]
    assert len(rows[0]) == sum(len(v) for v in whole.values())


def test_an_empty_topic_is_listed(tmp_path, drive):
    silent = HeadingSamples([], [], np.empty((0, 4)), [])
    path = write_bag(tmp_path / 'bag', [encode.counter('/odometer', drive.odometer),
                                        encode.heading('/heading', silent)])
    from rosbags.highlevel import AnyReader
    with AnyReader([path]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections}['/heading'] == 0


def counts():
    return [encode.counter('/odometer', OdometerSamples([1, 2], [1, 2], np.array([5, 6])))]


def test_an_existing_bag_is_kept_unless_forced(tmp_path):
    path = write_bag(tmp_path / 'bag', counts())
    with pytest.raises(BadUsage, match='already exists; give --force'):
        write_bag(path, counts())
    (path / 'old.mcap').touch()
    write_bag(path, counts(), force=True)
    assert not (path / 'old.mcap').exists()
    assert len(messages(path)['/odometer']) == 2


def test_only_a_bag_folder_is_replaced_and_an_unwritable_path_is_refused(tmp_path):
    (tmp_path / 'home').mkdir()
    (tmp_path / 'home' / 'thesis.txt').write_text('ten years')
    with pytest.raises(BadUsage, match='is not a bag; choose another'):
        write_bag(tmp_path / 'home', counts(), force=True)
    assert (tmp_path / 'home' / 'thesis.txt').read_text() == 'ten years'
    (tmp_path / 'file').touch()
    with pytest.raises(BadUsage, match='cannot be written'):
        write_bag(tmp_path / 'file' / 'bag', counts())


@pytest.mark.parametrize(('storage', 'compression', 'reported'), [
    ('rar', 'none', '--storage rar: required: one of mcap'),
    ('mcap', 'lz77', '--compression lz77: required: one of none'),
    ('sqlite3', 'storage', '--compression storage is not available for --storage sqlite3')])
def test_an_unknown_storage_or_compression_is_refused(tmp_path, storage, compression, reported):
    with pytest.raises(BadUsage, match=reported):
        write_bag(tmp_path / 'bag', counts(), storage, compression)
    assert not (tmp_path / 'bag').exists()


def test_a_failed_writer_leaves_no_file(tmp_path):
    def broken(rows):
        if rows.stop > 1:
            raise OSError(28, 'No space left on device')
        return whole.pack(rows)
    (whole,) = counts()
    topic = encode.Topic(whole.name, whole.msgtype, whole.time_ns, broken)
    with pytest.raises(BadUsage, match='No space left on device'):
        write_bag(tmp_path / 'bag', [topic])
    assert list(tmp_path.iterdir()) == []
