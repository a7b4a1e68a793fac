# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of every kind and every kind of damage, through the one way in."""

from contextlib import closing
import dataclasses
import hashlib
from pathlib import Path
import shutil
import sqlite3
import tracemalloc

import numpy as np
import pytest
import ros_bags
from ros_bags import T0
import ros_messages as make

from odocal_ros.bagio import parts
from odocal_ros.bagio.read import bag_sha256, open_bag
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadBag, BadData, BadUsage
from odocal_ros.messages.decode import make_reader
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
SLOTS = {'/imu/data': 'imu', '/odometer': 'odometer', '/fix': 'fix'}
KINDS = [('mcap', 'none'), ('mcap', 'storage'), ('mcap', 'file'), ('mcap', 'message'),
         ('sqlite3', 'none'), ('sqlite3', 'file'), ('sqlite3', 'message')]


def contents(bag, slots=None):
    """Return all rows of the topics, by slot and field."""
    recorder = LegRecorder()
    slots = slots or {topic: slot for topic, slot in SLOTS.items() if topic in bag.topics}
    readers = {topic: make_reader(slot, bag.topics[topic].msgtype, Config())
               for topic, slot in slots.items()}
    shares = []
    bag.read(readers, recorder.feed, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] <= 1
    return {(slot, f.name): getattr(recorder.rows(slot), f.name)
            for slot in slots.values() for f in dataclasses.fields(recorder.rows(slot))}


def same(found, wanted):
    return found.keys() == wanted.keys() and all(
        found[k].tobytes() == wanted[k].tobytes() for k in wanted)


def texts(bag):
    return [note if isinstance(note, str) else note.text for note in bag.notes]


def read(path):
    with open_bag(path) as bag:
        return contents(bag), bag.notes


@pytest.fixture(scope='session')
def plain(tmp_path_factory):
    """Return a plain mcap bag of ten seconds."""
    return ros_bags.write(tmp_path_factory.mktemp('plain') / 'drive', ros_bags.drive())


@pytest.fixture(scope='session')
def wanted(plain):
    return read(plain)[0]


# ---- what rosbag2 itself wrote -------------------------------------------------------------

@pytest.mark.parametrize(('name', 'files', 'topics'), [
    ('split5_mcap', 5, {'AAA': 804, 'HHH': 726}),
    ('split5_sqlite3_v4', 5, {'AAA': 804, 'HHH': 726}),
    ('talker_mcap', 1, {'/topic': 10, '/rosout': 10, '/parameter_events': 0}),
    ('talker_sqlite3', 1, {'/topic': 10, '/rosout': 10, '/parameter_events': 0}),
    ('split3_mcap_no_metadata', 3, {'/chatter': 3177}),
    ('split3_sqlite3_no_metadata', 3, {'/chatter': 3177}),
    ('cdr_test_mcap', 1, {'/array_topic': 4, '/test_topic': 3}),
    ('service_events_mcap', 1, {'/test_topic1': 1, '/test_topic2': 1}),
    ('autoware_kinematic_state_no_metadata.db3', 1, {'/localization/kinematic_state': 2130})])
def test_bags_of_rosbag2(data_dir, name, files, topics):
    with open_bag(data_dir / 'reader_bags' / name) as bag:
        assert len(bag.files) == files
        for topic, count in topics.items():
            assert bag.topics[topic].count == count
            messages = list(bag.messages(topic))
            assert len(messages) == count
            times = [time for time, _ in messages]
            assert times == sorted(times)
            assert all(bag.start_ns <= time <= bag.end_ns for time in times)
        said = any('metadata.yaml is missing; read 3 files' in text for text in texts(bag))
        assert said == ('split3' in name)


def test_split_bag_is_read_as_one(data_dir):
    with open_bag(data_dir / 'reader_bags' / 'split5_mcap') as bag:
        assert sum(topic.count for topic in bag.topics.values()) == 6074
        mcap = {t: [(ns, m.data) for ns, m in bag.messages(t)] for t in bag.topics}
    with open_bag(data_dir / 'reader_bags' / 'split5_mcap' / 'wbag_3.mcap') as bag:
        assert sum(topic.count for topic in bag.topics.values()) == 1240
    assert sum(map(len, mcap.values())) == 6074


@pytest.mark.parametrize(('name', 'says'), [
    ('empty_sqlite3_with_wal', 'the bag is empty, 0 messages on 2 topics'),
    ('unknown_serialization_sqlite3', "'wrong_format', only cdr"),
    ('README.md', 'is not a bag'), ('nothing_here', 'no such file or folder')])
def test_bags_that_cannot_be_read(data_dir, name, says):
    with pytest.raises(BadBag, match=says), open_bag(data_dir / 'reader_bags' / name):
        pass


def test_real_odometry_goes_through_the_reader(data_dir):
    path = data_dir / 'reader_bags' / 'autoware_kinematic_state_no_metadata.db3'
    with open_bag(path) as bag:
        rows = contents(bag, {'/localization/kinematic_state': 'odometer'})
        first = next(message for _, message in bag.messages('/localization/kinematic_state'))
    assert len(rows['odometer', 'value']) == 2130
    assert rows['odometer', 'value'][0] == first.twist.twist.linear.x


# ---- kinds of bags -------------------------------------------------------------------------

@pytest.mark.parametrize(('storage', 'compression'), KINDS)
def test_storages_and_compressions_hold_the_same(tmp_path, wanted, storage, compression):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(), storage, compression)
    found, notes = read(path)
    assert same(found, wanted)
    assert notes == ()
    file = next(f for f in path.iterdir() if f.name != 'metadata.yaml')
    for way_in in (file, path / 'metadata.yaml'):
        assert same(read(way_in)[0], wanted)
    (path / 'metadata.yaml').unlink()
    found, notes = read(path)
    assert same(found, wanted)
    assert len(notes) == 1
    assert 'metadata.yaml is missing' in notes[0]


def test_rosbag1(tmp_path, wanted):
    path = ros_bags.write(tmp_path / 'drive.bag', ros_bags.drive(), 'rosbag1')
    assert same(read(path)[0], wanted)
    with open_bag(path) as bag:
        assert bag.name == 'drive'
        assert (bag.start_ns, bag.end_ns) == (T0 + 1000, T0 + 9_990_001_000)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'rosbag1'])
def test_split_files_in_number_order(tmp_path, wanted, storage):
    rows = ros_bags.drive()
    folder = tmp_path / 'split'
    folder.mkdir()
    for k in range(11):            # bag_10 comes after bag_9, not after bag_1
        piece = ros_bags.write(tmp_path / f'p{k}', rows[k * 150:(k + 1) * 150 if k < 10 else None],
                               storage)
        file = piece if piece.is_file() else next(
            f for f in piece.iterdir() if f.name != 'metadata.yaml')
        shutil.copy(file, folder / f'bag_{k}{file.suffix or ".bag"}')
    assert same(read(folder)[0], wanted)
    with open_bag(folder) as bag:
        assert [f.name.split('.')[0] for f in bag.files] == [f'bag_{k}' for k in range(11)]


def test_files_that_overlap_are_merged_by_time(tmp_path, wanted, monkeypatch):
    monkeypatch.setattr(parts, 'BLOCK', 64)    # so that a topic crosses many batches
    rows = ros_bags.drive()
    folder = tmp_path / 'both'
    folder.mkdir()
    for k in (0, 1):
        piece = ros_bags.write(tmp_path / f'p{k}', rows[k::2])
        shutil.copy(piece / f'p{k}.mcap', folder)
    found, _ = read(folder)
    assert same(found, wanted)


def test_file_with_another_ending(tmp_path, plain, wanted):
    shutil.copy(plain / 'drive.mcap', tmp_path / 'drive.mcap.active')
    assert same(read(tmp_path / 'drive.mcap.active')[0], wanted)


def test_changes_still_in_the_wal(tmp_path, wanted):
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


def test_foreign_types_come_with_the_bag(tmp_path):
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('std_msgs/Header header\nint32 ticks_left\n',
                                      'create_msgs/msg/WheelTicks'))
    kind = store.types['create_msgs/msg/WheelTicks']
    from rosbags.rosbag2 import Writer
    for storage in ('mcap', 'sqlite3'):
        with Writer(tmp_path / storage, version=9,
                    storage_plugin=ros_bags.STORAGES[storage]) as bag:
            topic = bag.add_connection('/ticks', kind.__msgtype__, typestore=store)
            for i in range(5):
                message = kind(header=make.header(T0 + i), ticks_left=10 * i)
                bag.write(topic, T0 + i, store.serialize_cdr(message, kind.__msgtype__))
        settings = with_settings(Config(), {'odometer.field': 'ticks_left'})
        with open_bag(tmp_path / storage) as bag:
            reader, recorder = make_reader('odometer', kind.__msgtype__, settings), LegRecorder()
            bag.read({'/ticks': reader}, recorder.feed)
            assert recorder.rows('odometer').value.tolist() == [0, 10, 20, 30, 40]
            assert recorder.rows('odometer').stamp_ns.tolist() == [T0 + i for i in range(5)]
    # without the definition nothing can be done, and it is said
    with closing(sqlite3.connect(tmp_path / 'sqlite3' / 'sqlite3.db3')) as db, db:
        db.execute('DELETE FROM message_definitions')
    with open_bag(tmp_path / 'sqlite3') as bag:
        reader = make_reader('odometer', kind.__msgtype__, settings)
        with pytest.raises(BadData, match='holds no definition'):
            bag.read({'/ticks': reader}, print)


def test_sums_are_those_of_sha256sum(data_dir, plain):
    with open_bag(plain) as bag:
        assert bag_sha256(bag) == hashlib.sha256((plain / 'drive.mcap').read_bytes()).hexdigest()
    with open_bag(data_dir / 'reader_bags' / 'split3_mcap_no_metadata') as bag:
        listing = ''.join(f'{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.name}\n'
                          for f in bag.files)
        assert bag_sha256(bag) == hashlib.sha256(listing.encode()).hexdigest()


def test_memory_stays_bounded_with_a_camera_beside(tmp_path):
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


# ---- damage --------------------------------------------------------------------------------

@pytest.mark.parametrize(('storage', 'compression'), [
    ('mcap', 'none'), ('mcap', 'storage'), ('mcap', 'file'), ('sqlite3', 'none'),
    ('sqlite3', 'file')])
@pytest.mark.parametrize('share', [0.35, 0.5, 0.65])
def test_bag_cut_off_gives_what_is_there(tmp_path, wanted, storage, compression, share):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(), storage, compression)
    file = next(f for f in path.iterdir() if f.name != 'metadata.yaml')
    data = file.read_bytes()
    file.write_bytes(data[:int(len(data) * share)])
    found, notes = read(path)
    for key, column in found.items():          # a prefix of the whole, row for row
        assert column.tobytes() == wanted[key][:len(column)].tobytes()
    rows = len(found['imu', 'stamp_ns'])
    if compression == 'none':
        # index and definitions take some of the file: never more than a third of this one
        assert share - 0.35 < rows / len(wanted['imu', 'stamp_ns']) <= min(1, share + 0.35)
    reason, = notes
    assert reason.code is Code.BAG_TRUNCATED
    last = max(found[slot, 'received_ns'][-1] for slot in SLOTS.values() if len(
        found[slot, 'received_ns']))
    missing = (T0 + 9_990_001_000 - last) * 1e-9
    assert f'{missing:.1f} s at the end are missing' in reason.text
    (path / 'metadata.yaml').unlink()
    with open_bag(path) as bag:
        assert any('without metadata.yaml the lost time is unknown' in text for text in texts(bag))


def test_an_mcap_that_lost_only_its_index(tmp_path, plain, wanted):
    path = shutil.copytree(plain, tmp_path / 'bag')
    data = (path / 'drive.mcap').read_bytes()
    (path / 'drive.mcap').write_bytes(data[:-100])
    found, notes = read(path)
    assert same(found, wanted)
    assert notes == ('drive.mcap is damaged (cut off), but all 1550 messages were read',)


def test_large_rows_of_a_cut_database_span_pages(tmp_path):
    """Rows beyond a page lie on overflow pages: those whole are kept, to the last byte."""
    rng = np.random.default_rng(1)
    images = [make.kind('sensor_msgs/msg/CompressedImage')(
        header=make.header(T0 + i), format='x' * (i % 7),
        data=rng.integers(0, 255, int(size), np.uint8))
        for i, size in enumerate(rng.integers(10, 20_000, 60))]
    path = ros_bags.write(tmp_path / 'bag', [('/camera', T0 + i, m) for i, m in enumerate(images)],
                          'sqlite3')
    file = path / 'bag.db3'
    file.write_bytes(file.read_bytes()[:-150_000])
    with open_bag(path) as bag:
        found = list(bag.messages('/camera'))
    assert 20 < len(found) < 60
    for time, message in found:
        assert message.data.tobytes() == images[time - T0].data.tobytes()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_nothing_left(tmp_path, storage):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(1.0), storage)
    file = next(f for f in path.iterdir() if f.name != 'metadata.yaml')
    data = file.read_bytes()
    for size in (0, 5, 100, 1000):
        file.write_bytes(data[:size])
        with pytest.raises(BadBag, match=r'empty|not a bag|cannot be read'), open_bag(path):
            pass


def test_file_of_garbage(tmp_path):
    rng = np.random.default_rng(2)
    for magic in (b'\x89MCAP0\r\n', b'SQLite format 3\0', b'#ROSBAG V2.0\n', b'(\xb5/\xfd', b''):
        file = tmp_path / 'garbage'
        for _ in range(20):
            file.write_bytes(magic + rng.bytes(3000))
            with pytest.raises(BadBag), open_bag(file):
                pass


def test_bag_shorter_than_its_metadata_tell(tmp_path, plain):
    path = ros_bags.write(tmp_path / 'drive', ros_bags.drive(4.0))
    shutil.copy(plain / 'metadata.yaml', path)
    with open_bag(path) as bag:
        reason, = bag.notes
    assert reason.code is Code.BAG_TRUNCATED
    assert '6.0 s at the end, listed in metadata.yaml,' in reason.text


def test_metadata_that_cannot_be_used(tmp_path, plain, wanted):
    for text in ('{', '[]', 'rosbag2_bagfile_information: 3', ''):
        path = shutil.copytree(plain, tmp_path / f'bag{len(text)}')
        (path / 'metadata.yaml').write_text(text)
        found, notes = read(path)
        assert same(found, wanted)
        assert 'cannot be parsed' in notes[0]
    path = shutil.copytree(plain, tmp_path / 'renamed')
    (path / 'drive.mcap').rename(path / 'other.mcap')
    found, notes = read(path)
    assert same(found, wanted)
    assert 'names no existing file' in notes[0]


def test_a_lost_or_ruined_split_file_leaves_the_others(tmp_path):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(2.0))
    text = (path / 'metadata.yaml').read_text()
    (path / 'metadata.yaml').write_text(text.replace('- bag.mcap\n', '- bag.mcap\n  - b_1.mcap\n'))
    with open_bag(path) as bag:
        (note,) = bag.notes
        assert note.code is Code.BAG_TRUNCATED
        assert '1 of 2 files named in metadata.yaml are missing (b_1.mcap)' in note.text
    (path / 'b_1.mcap').write_bytes(b'')
    with open_bag(path) as bag:
        (note,) = bag.notes
        assert note.code is Code.BAG_TRUNCATED
        assert 'b_1.mcap: is an empty file' in note.text
        assert bag.topics['/imu/data'].count == 200


def test_damaged_messages_are_left_out_and_told(tmp_path):
    rows = ros_bags.drive(1.0)
    rows[30] = (rows[30][0], rows[30][1], make.cdr(rows[30][2])[:20])
    path = ros_bags.write(tmp_path / 'bag', rows)
    found, notes = read(path)
    lost = {'/imu/data': 'imu', '/fix': 'fix', '/odometer': 'odometer'}[rows[30][0]]
    assert len(found[lost, 'stamp_ns']) == sum(row[0] == rows[30][0] for row in rows) - 1
    assert notes[0].code is Code.BAD_ROWS_DROPPED
    assert '1 of' in notes[0].text
    path = ros_bags.write(tmp_path / 'bad', [('/imu/data', T0, b'\x00\x01\x00\x00\x01')],
                          types={'/imu/data': 'sensor_msgs/msg/Imu'})
    with pytest.raises(BadData, match='none of its 1 messages can be used'):
        read(path)


def test_topic_with_two_types_is_read_as_the_frequent_one(tmp_path):
    from rosbags.rosbag2 import Writer
    with Writer(tmp_path / 'bag', version=9, storage_plugin=ros_bags.STORAGES['mcap']) as bag:
        for kind, messages in (('Int32', 2), ('Int64', 5)):
            topic = bag.add_connection('/odometer', f'std_msgs/msg/{kind}', typestore=make.store())
            for i in range(messages):
                bag.write(topic, T0 + i, make.cdr(make.whole(i, kind)))
    with open_bag(tmp_path / 'bag') as bag:
        rows = contents(bag)
        assert rows['odometer', 'value'].tolist() == [0, 1, 2, 3, 4]
        assert 'messages of 2 types' in texts(bag)[0]


def test_what_is_asked_wrongly(tmp_path, plain, monkeypatch):
    with open_bag(plain) as bag:
        assert list(bag.messages('/nothing')) == []
        with pytest.raises(BadUsage, match='no topic /x; topics: /fix, /imu/data, /odometer'):
            bag.read({'/x': make_reader('imu', 'sensor_msgs/msg/Imu', Config())}, print)
    with pytest.raises(BadBag, match=f'did you mean {plain}'), open_bag(plain.parent):
        pass
    (tmp_path / 'a').mkdir()
    with pytest.raises(BadBag, match='holds no .mcap, .db3 or .bag file$'), open_bag(tmp_path):
        pass
    with pytest.raises(BadBag, match='rosbag reindex'), open_bag(_unindexed(tmp_path)):
        pass

    def refuse(self, *_, **__):
        raise PermissionError(13, 'Permission denied', str(self))
    monkeypatch.setattr(Path, 'open', refuse)     # root, as in CI, may read everything
    with pytest.raises(BadBag, match='drive/metadata.yaml: no permission'), open_bag(plain):
        pass


def _unindexed(folder):
    """Return a rosbag1 file that was never closed."""
    path = ros_bags.write(folder / 'x.bag', ros_bags.drive(0.1), 'rosbag1')
    data = path.read_bytes()
    at = data.index(b'index_pos=') + len(b'index_pos=')
    path.write_bytes(data[:at] + bytes(8) + data[at + 8:])
    return path


def test_the_frame_is_that_of_the_first_message_that_can_be_read(tmp_path):
    """Big endian too, which has no layout; frames that are no text are no frames."""
    little, odd = (bytearray(make.cdr(make.imu(T0, frame=frame))) for frame in ('a é', 'axx'))
    odd[17] = 0xff
    for first, wanted in ((little[:40], 'b'), (odd, 'b'), (little, 'a é'),
                          (make.cdr(make.imu(T0, frame='big'), False), 'big'),
                          (make.cdr(make.imu(T0, frame='')), '')):
        path = ros_bags.write(tmp_path / wanted / f'{len(first)}', [
            ('/imu', T0, bytes(first)), ('/imu', T0 + 1, make.imu(T0 + 1, frame='b'))],
            types={'/imu': 'sensor_msgs/msg/Imu'})
        with open_bag(path) as bag:
            assert bag.frame('/imu') == wanted
            assert next(m for _, m in bag.messages('/imu')).header.frame_id == wanted
