# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of every kind read by open_bag, and paths that are not bags."""

from contextlib import closing
import hashlib
from pathlib import Path
import shutil
import sqlite3
import tracemalloc

from bag_content import contents, file_of, read, same
import numpy as np
import pytest
import ros_bags
from ros_bags import T0
import ros_messages as make

from odocal_ros.bagio import bag_file
from odocal_ros.bagio.read import bag_sha256, open_bag
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadBag, BadData, BadUsage
from odocal_ros.messages.decode import make_reader
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
SPLIT, TALKER = {'AAA': 804, 'HHH': 726}, {'/topic': 10, '/rosout': 10, '/parameter_events': 0}


@pytest.mark.parametrize(('name', 'files', 'messages', 'topics'), [
    ('split5_mcap', 5, 6074, SPLIT), ('split5_mcap/wbag_3.mcap', 1, 1240, {}),
    ('split5_sqlite3_v4', 5, 6074, SPLIT), ('talker_mcap', 1, 20, TALKER),
    ('talker_sqlite3', 1, 20, TALKER), ('split3_mcap_no_metadata', 3, None, {'/chatter': 3177}),
    ('split3_sqlite3_no_metadata', 3, None, {'/chatter': 3177}),
    ('cdr_test_mcap', 1, None, {'/array_topic': 4, '/test_topic': 3}),
    ('service_events_mcap', 1, None, {'/test_topic1': 1, '/test_topic2': 1}),
    ('autoware_kinematic_state_no_metadata.db3', 1, 2130,
     {'/localization/kinematic_state': 2130})])
def test_bags_of_rosbag2_are_read(data_dir, name, files, messages, topics):
    with open_bag(data_dir / 'reader_bags' / name) as bag:
        assert len(bag.files) == files
        assert messages in (None, sum(topic.count for topic in bag.topics.values()))
        for topic, count in topics.items():
            times = [time for time, _ in bag.messages(topic)]
            assert bag.topics[topic].count == len(times) == count
            assert times == sorted(times)
            assert all(bag.start_ns <= time <= bag.end_ns for time in times)
        is_noted = 'metadata.yaml is missing; read 3 files' in str(bag.notes)
        assert is_noted == ('split3' in name)


@pytest.mark.parametrize(('name', 'says'), [
    ('empty_sqlite3_with_wal', 'with_wal: the bag is empty, 0 messages on 2 topics'),
    ('unknown_serialization_sqlite3', "'wrong_format', only cdr"),
    ('README.md', 'a text file, which is not a bag'), ('nothing_here', 'no such file or folder')])
def test_bags_that_cannot_be_read_are_refused_with_the_reason(data_dir, name, says):
    with pytest.raises(BadBag, match=says), open_bag(data_dir / 'reader_bags' / name):
        pass


@pytest.mark.parametrize(('storage', 'compression'), [
    ('mcap', 'none'), ('mcap', 'storage'), ('mcap', 'file'), ('mcap', 'message'),
    ('sqlite3', 'none'), ('sqlite3', 'file'), ('sqlite3', 'message')])
def test_storages_and_compressions_give_the_same_rows(tmp_path, expected, storage, compression):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(), storage, compression)
    found, notes = read(path)
    assert same(found, expected)
    assert notes == ()
    for way_in in (file_of(path), path / 'metadata.yaml'):
        assert same(read(way_in)[0], expected)
    (path / 'metadata.yaml').unlink()
    found, (note,) = read(path)
    assert same(found, expected)
    assert 'metadata.yaml is missing' in note
    shutil.copy(file_of(path), tmp_path / 'drive.active')       # another extension
    assert same(read(tmp_path / 'drive.active')[0], expected)


def test_a_rosbag1_file_gives_the_same_rows(tmp_path, expected):
    path = ros_bags.write(tmp_path / 'drive.bag', ros_bags.drive(), 'rosbag1')
    assert same(read(path)[0], expected)
    with open_bag(path) as bag:
        assert bag.name == 'drive'
        assert (bag.start_ns, bag.end_ns) == (T0 + 1000, T0 + 9_990_001_000)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'rosbag1'])
def test_split_files_are_read_in_order_of_their_numbers(tmp_path, expected, storage):
    rows = ros_bags.drive()
    folder = tmp_path / 'split'
    folder.mkdir()
    for k in range(11):            # bag_10 comes after bag_9, not after bag_1
        piece = ros_bags.write(tmp_path / f'p{k}', rows[k * 150:(k + 1) * 150 if k < 10 else None],
                               storage)
        shutil.copy(file_of(piece), folder / f'bag_{k}{file_of(piece).suffix or ".bag"}')
    assert same(read(folder)[0], expected)
    with open_bag(folder) as bag:
        assert [f.name.split('.')[0] for f in bag.files] == [f'bag_{k}' for k in range(11)]


def test_files_that_overlap_are_merged_by_time(tmp_path, expected, monkeypatch):
    monkeypatch.setattr(bag_file, 'BATCH_MESSAGES', 64)    # so that a topic crosses many batches
    rows = ros_bags.drive()
    folder = tmp_path / 'both'
    folder.mkdir()
    for k in (0, 1):
        piece = ros_bags.write(tmp_path / f'p{k}', rows[k::2])
        shutil.copy(piece / f'p{k}.mcap', folder)
    found, _ = read(folder)
    assert same(found, expected)


def test_changes_in_the_wal_are_read_and_no_file_is_changed(tmp_path, expected):
    rows = ros_bags.drive()
    path = ros_bags.write(tmp_path / 'bag', rows, 'sqlite3')
    db = sqlite3.connect(path / 'bag.db3')
    db.execute('PRAGMA journal_mode=WAL')
    db.execute('PRAGMA wal_autocheckpoint=0')
    db.execute('DELETE FROM messages WHERE id > 700')
    db.commit()
    copy = tmp_path / 'killed'
    copy.mkdir()
    for name in ('bag.db3', 'bag.db3-wal', 'bag.db3-shm'):
        shutil.copy(path / name, copy)
    db.close()
    before = {f.name: f.read_bytes() for f in copy.iterdir()}
    with open_bag(copy) as bag:
        assert sum(topic.count for topic in bag.topics.values()) == 700
    assert {f.name: f.read_bytes() for f in copy.iterdir()} == before


def test_foreign_types_are_read_by_the_definitions_in_the_bag(tmp_path):
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores
    name, store = 'create_msgs/msg/WheelTicks', get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('std_msgs/Header header\nint32 ticks_left\n', name))
    rows = [('/ticks', T0 + i, bytes(store.serialize_cdr(store.types[name](
        header=make.header(T0 + i), ticks_left=10 * i), name))) for i in range(5)]
    settings = with_settings(Config(), {'odometer.field': 'ticks_left'})
    for storage in ('mcap', 'sqlite3'):
        path = ros_bags.write(tmp_path / storage, rows, storage, types={'/ticks': name},
                              store=store)
        with open_bag(path) as bag:
            reader, recorder = make_reader('odometer', name, settings), LegRecorder()
            bag.read({'/ticks': reader}, recorder.feed)
            assert recorder.rows('odometer').value.tolist() == [0, 10, 20, 30, 40]
            assert recorder.rows('odometer').stamp_ns.tolist() == [T0 + i for i in range(5)]
    # without the definition nothing can be read, and an error states this
    with closing(sqlite3.connect(tmp_path / 'sqlite3' / 'sqlite3.db3')) as db, db:
        db.execute('DELETE FROM message_definitions')
    with open_bag(tmp_path / 'sqlite3') as bag, pytest.raises(
            BadData, match='holds no definition'):
        bag.read({'/ticks': make_reader('odometer', name, settings)}, print)


@pytest.mark.parametrize(('name', 'field_type', 'field'), [
    ('irobot_create_msgs/msg/WheelTicks', 'int32', 'ticks_left ticks_right'),
    ('dbw_ford_msgs/msg/WheelSpeedReport', 'float32',
     'front_left front_right rear_left rear_right'),
    ('pacmod3_msgs/msg/WheelSpeedRpt', 'float64',
     'front_left_wheel_speed front_right_wheel_speed '
     'rear_left_wheel_speed rear_right_wheel_speed')])
def test_known_types_are_read_from_bags_without_definitions(tmp_path, name, field_type, field):
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores
    store, fields = get_typestore(Stores.ROS2_JAZZY), field.split()
    store.register(get_types_from_msg('std_msgs/Header header\n' + ''.join(
        f'{field_type} {field}\n' for field in fields), name))
    rows = [('/wheels', T0 + i, bytes(store.serialize_cdr(store.types[name](
        make.header(T0 + i), *(10 * i + k for k in range(len(fields)))), name))) for i in range(5)]
    path = ros_bags.write(tmp_path / 'bag', rows, 'sqlite3', types={'/wheels': name}, store=store)
    with closing(sqlite3.connect(path / 'bag.db3')) as db, db:
        db.execute('DELETE FROM message_definitions')
    last_field = with_settings(Config(), {'odometer.field': fields[-1]})
    with open_bag(path) as bag:
        reader, recorder = make_reader('odometer', name, last_field), LegRecorder()
        bag.read({'/wheels': reader}, recorder.feed)
    assert recorder.rows('odometer').value.tolist() == [
        10 * i + len(fields) - 1 for i in range(5)]


def test_checksums_agree_with_sha256sum(data_dir, plain):
    with open_bag(plain) as bag:
        assert bag_sha256(bag) == hashlib.sha256((plain / 'drive.mcap').read_bytes()).hexdigest()
    with open_bag(data_dir / 'reader_bags' / 'split3_mcap_no_metadata') as bag:
        listing = ''.join(f'{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n'
                          for f in bag.files)
        assert bag_sha256(bag) == hashlib.sha256(listing.encode()).hexdigest()


def test_memory_stays_bounded_if_the_bag_has_camera_images(tmp_path):
    picture = np.random.default_rng(0).integers(0, 255, 400_000, np.uint8)
    image = make.kind('sensor_msgs/msg/CompressedImage')(
        header=make.header(T0), format='jpeg', data=picture)
    rows = [('/camera', T0 + i * 10**7, image) for i in range(150)] + ros_bags.drive(2.0)
    rows.sort(key=lambda row: row[1])
    for storage in ('mcap', 'sqlite3'):
        path = ros_bags.write(tmp_path / storage, rows, storage)
        assert sum(f.stat().st_size for f in path.iterdir()) > 60e6
        tracemalloc.start()
        with open_bag(path) as bag:
            contents(bag)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        # a chunk of 1 MiB and its copies, imports and 240 rows; the pictures are 60 MB
        assert peak < 20e6


def test_a_topic_with_two_types_is_read_as_the_more_frequent_one(tmp_path):
    from rosbags.rosbag2 import Writer
    with Writer(tmp_path / 'bag', version=9, storage_plugin=ros_bags.STORAGES['mcap']) as bag:
        for kind, messages in (('Int32', 2), ('Int64', 5)):
            topic = bag.add_connection('/odometer', f'std_msgs/msg/{kind}', typestore=make.store())
            for i in range(messages):
                bag.write(topic, T0 + i, make.cdr(make.whole(i, kind)))
    with open_bag(tmp_path / 'bag') as bag:
        rows = contents(bag)
        assert rows['odometer', 'value'].tolist() == [0, 1, 2, 3, 4]
        assert 'messages of 2 types' in bag.notes[0]


def test_wrong_topics_and_paths_are_refused_with_the_cause(tmp_path, plain, monkeypatch):
    with open_bag(plain) as bag:
        assert list(bag.messages('/nothing')) == []
        with pytest.raises(BadUsage, match=r'no topic /x; the bag has:\n  /fix,\n  /imu/'):
            bag.read({'/x': make_reader('imu', 'sensor_msgs/msg/Imu', Config())}, print)
    with pytest.raises(BadBag, match=f'did you mean {plain}'), open_bag(plain.parent):
        pass
    for name in ('gps', 'imu'):
        shutil.copytree(plain, tmp_path / 'sensors' / name)
    with pytest.raises(BadBag, match=r'/gps or .*/imu\? If they are one drive, put their files'), \
            open_bag(tmp_path / 'sensors'):
        pass
    (tmp_path / 'a').mkdir()
    with pytest.raises(BadBag, match='holds no .mcap, .db3 or .bag file$'), open_bag(tmp_path):
        pass
    path = ros_bags.write(tmp_path / 'x.bag', ros_bags.drive(0.1), 'rosbag1')
    before, key, after = path.read_bytes().partition(b'index_pos=')
    path.write_bytes(before + key + bytes(8) + after[8:])       # like a bag that was never closed
    with pytest.raises(BadBag, match='rosbag reindex'), open_bag(path):
        pass

    def refuse(self, *_, **__):
        raise PermissionError(13, 'Permission denied', str(self))
    monkeypatch.setattr(Path, 'open', refuse)     # root, as in CI, may read everything
    with pytest.raises(BadBag, match='drive/metadata.yaml: no permission'), open_bag(plain):
        pass


def test_the_frame_is_that_of_the_first_readable_message(tmp_path):
    """Also of big-endian messages, which have no layout; invalid text is not a frame."""
    little, odd = (bytearray(make.cdr(make.imu(T0, frame=frame))) for frame in ('a é', 'axx'))
    odd[17] = 0xff
    for first, expected in ((little[:40], 'b'), (odd, 'b'), (little, 'a é'),
                            (make.cdr(make.imu(T0, frame='big'), False), 'big'),
                            (make.cdr(make.imu(T0, frame='')), '')):
        path = ros_bags.write(tmp_path / expected / f'{len(first)}', [
            ('/imu', T0, bytes(first)), ('/imu', T0 + 1, make.imu(T0 + 1, frame='b'))],
            types={'/imu': 'sensor_msgs/msg/Imu'})
        with open_bag(path) as bag:
            assert bag.frame('/imu') == expected
            assert next(m for _, m in bag.messages('/imu')).header.frame_id == expected
