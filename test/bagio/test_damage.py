# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags that are cut off or damaged anywhere: undamaged data is read, and the loss is reported."""

import shutil
import sqlite3
import zlib

from bag_content import chunks_of, file_of, read, same, SLOTS
import numpy as np
import pytest
import ros_bags
from ros_bags import T0
import ros_messages as make

from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.sqlite_file import SqliteFile
from odocal_ros.errors import BadBag, BadData
from odocal_ros.reasons import Code
from odocal_ros.safe_io.limits import Allowance

pytestmark = pytest.mark.core


def truncated(notes):
    """Return the text of the only note, which is on a truncated bag."""
    note, = notes
    assert note.code is Code.BAG_TRUNCATED
    return note.text


@pytest.mark.parametrize(('storage', 'compression'), [
    ('mcap', 'none'), ('mcap', 'storage'), ('mcap', 'file'), ('sqlite3', 'none'),
    ('sqlite3', 'file')])
@pytest.mark.parametrize('share', [0.35, 0.5, 0.65])
def test_a_truncated_bag_gives_its_rows(tmp_path, expected, storage, compression, share):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(), storage, compression)
    data = file_of(path).read_bytes()
    file_of(path).write_bytes(data[:int(len(data) * share)])
    found, notes = read(path)
    for key, column in found.items():          # a prefix of the whole, row for row
        assert column.tobytes() == expected[key][:len(column)].tobytes()
    if compression == 'none':
        # index and definitions take some of the file: never more than a third of this one
        rows = len(found['imu', 'stamp_ns']) / len(expected['imu', 'stamp_ns'])
        assert share - 0.35 < rows <= min(1, share + 0.35)
    last = max(max(found[slot, 'received_ns'], default=0) for slot in SLOTS.values())
    missing = (T0 + 9_990_001_000 - last) * 1e-9
    assert f'{missing:.1f} s at the end are missing' in truncated(notes)
    (path / 'metadata.yaml').unlink()
    assert 'without metadata.yaml the lost time is unknown' in str(read(path)[1])


def test_an_mcap_file_without_its_index_is_read_completely(tmp_path, plain, expected):
    path = shutil.copytree(plain, tmp_path / 'bag')
    file_of(path).write_bytes(file_of(path).read_bytes()[:-100])
    found, notes = read(path)
    assert same(found, expected)
    assert notes == ('drive.mcap is damaged (truncated), but all 1550 messages were read',)


def test_large_rows_of_a_truncated_database_are_read_across_pages(tmp_path):
    """Rows larger than a page use overflow pages; complete rows are kept in every byte."""
    rng = np.random.default_rng(1)
    images = [make.kind('sensor_msgs/msg/CompressedImage')(
        header=make.header(T0 + i), format='x' * (i % 7),
        data=rng.integers(0, 255, int(size), np.uint8))
        for i, size in enumerate(rng.integers(10, 20_000, 60))]
    path = ros_bags.write(tmp_path / 'bag', [('/camera', T0 + i, m) for i, m in enumerate(images)],
                          'sqlite3')
    file_of(path).write_bytes(file_of(path).read_bytes()[:-150_000])
    with open_bag(path) as bag:
        found = list(bag.messages('/camera'))
    assert 20 < len(found) < 60
    for time, message in found:
        assert message.data.tobytes() == images[time - T0].data.tobytes()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_file_without_usable_content_is_refused(tmp_path, storage):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(1.0), storage)
    data, rng = file_of(path).read_bytes(), np.random.default_rng(2)
    magics = (data[:16], b'#ROSBAG V2.0\n', b'(\xb5/\xfd', b'')
    for left in (*(data[:size] for size in (0, 5, 100, 1000)),
                 *(magic + rng.bytes(3000) for magic in magics for _ in range(20))):
        file_of(path).write_bytes(left)
        with pytest.raises(BadBag, match=r'empty|not a bag|cannot be read'), open_bag(path):
            pass


def test_unusable_metadata_is_reported_and_the_files_are_read(tmp_path, plain, expected):
    for text in ('{', '[]', 'rosbag2_bagfile_information: 3', '', None):
        path = shutil.copytree(plain, tmp_path / f'bag{text and len(text)}')
        if text is None:
            file_of(path).rename(path / 'other.mcap')
        else:
            (path / 'metadata.yaml').write_text(text)
        found, notes = read(path)
        assert same(found, expected)
        assert ('names no existing file' if text is None else 'cannot be parsed') in notes[0]


def test_files_that_are_shorter_than_listed_missing_or_empty_are_reported(tmp_path, plain):
    path = ros_bags.write(tmp_path / 'drive', ros_bags.drive(4.0))
    metadata = (path / 'metadata.yaml').read_text()
    shutil.copy(plain / 'metadata.yaml', path)
    assert '6.0 s at the end, listed in metadata.yaml,' in truncated(read(path)[1])
    (path / 'metadata.yaml').write_text(
        metadata.replace('- drive.mcap\n', '- drive.mcap\n  - b_1.mcap\n'))
    assert '1 of 2 files named in metadata.yaml are missing (b_1.mcap)' in truncated(read(path)[1])
    (path / 'b_1.mcap').write_bytes(b'')
    found, notes = read(path)
    assert 'b_1.mcap: an empty file' in truncated(notes)
    assert len(found['imu', 'stamp_ns']) == 400


def test_damaged_messages_are_omitted_and_reported(tmp_path):
    rows = ros_bags.drive(1.0)
    topic, time_ns, message = rows[30]
    rows[30] = topic, time_ns, make.cdr(message)[:20]
    found, notes = read(ros_bags.write(tmp_path / 'bag', rows))
    assert len(found[SLOTS[topic], 'stamp_ns']) == sum(row[0] == topic for row in rows) - 1
    assert notes[0].code is Code.BAD_ROWS_DROPPED
    assert '1 of' in notes[0].text
    path = ros_bags.write(tmp_path / 'bad', [('/imu/data', T0, b'\x00\x01\x00\x00\x01')],
                          types={'/imu/data': 'sensor_msgs/msg/Imu'})
    with pytest.raises(BadData, match='none of its 1 messages can be used'):
        read(path)


@pytest.fixture(scope='module', params=['none', 'storage'])
def mcap(request, tmp_path_factory):
    return ros_bags.write(tmp_path_factory.mktemp('mcap') / 'bag', ros_bags.drive(40.0), 'mcap',
                          request.param)


@pytest.fixture
def copied(mcap, tmp_path):
    """Return a copy of such a bag, and its bytes to be changed."""
    path = shutil.copytree(mcap, tmp_path / 'bag')
    return path, bytearray(file_of(path).read_bytes())


@pytest.mark.parametrize('where', ['record', 'length', 'head', 'name', 'data'])
@pytest.mark.parametrize('which', [0, 1])
def test_a_damaged_chunk_loses_only_its_own_messages(mcap, copied, which, where):
    path, data = copied
    at, size = chunks_of(data)[which]
    place = at + {'record': 0, 'length': 3, 'head': 25, 'name': 37, 'data': size // 2}[where]
    data[place:place + 8] = bytes(b ^ 0xA5 for b in data[place:place + 8])
    file_of(path).write_bytes(data)
    found, notes = read(path)
    whole, rows = (one['imu', 'stamp_ns'] for one in (read(mcap)[0], found))
    assert 0 < len(rows) < len(whole) or where == 'data'
    assert set(rows.tolist()) <= set(whole.tolist())
    assert (np.diff(rows) > 0).all()      # none twice
    assert [n.code for n in notes] == [Code.BAG_TRUNCATED] * len(notes)
    assert notes or where == 'data'       # only a checksum finds a changed value


def test_a_bag_without_an_undamaged_chunk_is_refused(copied):
    path, data = copied
    for at, size in chunks_of(data):
        data[at + size // 2] ^= 0xA5
        data[at + 33:at + 37] = b'crc!'
    file_of(path).write_bytes(data)
    with pytest.raises(BadBag, match=r'cannot be read \(invalid chunk\); copy it'):
        read(path)


def test_a_checksum_finds_a_changed_value(copied):
    path, data = copied
    at, size = chunks_of(data)[0]
    packed = at + 9 + 28 + 4 + int.from_bytes(data[at + 37:at + 41], 'little') + 8
    data[at + 33:at + 37] = zlib.crc32(data[packed:at + size]).to_bytes(4, 'little')
    data[packed + (size - 50) // 2] ^= 1
    file_of(path).write_bytes(data)
    assert 'invalid chunk' in read(path)[1][0].text      # packed: any change shows


def test_a_database_that_is_being_written_is_refused(tmp_path):
    path = file_of(ros_bags.write(tmp_path / 'bag', ros_bags.drive(2.0), 'sqlite3'))
    file = SqliteFile(path, Allowance(path, 1))
    rows = file.messages({'/imu/data': 'sensor_msgs/msg/Imu'})
    next(rows)
    with sqlite3.connect(path) as db:
        db.execute('INSERT INTO messages (topic_id, timestamp, data) '
                   'SELECT topic_id, timestamp + 1, data FROM messages')
    with pytest.raises(BadBag, match='changes while it is read; stop the recorder first'):
        list(rows)
    file.close()


def test_invalid_rows_of_a_database_are_omitted(tmp_path):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(2.0), 'sqlite3')
    whole = len(read(path)[0]['imu', 'stamp_ns'])
    db = sqlite3.connect(file_of(path))
    rows = db.execute('SELECT m.id FROM messages AS m JOIN topics AS t ON topic_id = t.id '
                      "WHERE name = '/imu/data'").fetchall()
    for row, change in zip(rows, ("data = 'text'", 'data = 17', "timestamp = 'noon'",
                                  'timestamp = 9223372036854775807', 'timestamp = -5',
                                  "topic_id = 'x'", 'topic_id = 99'), strict=False):
        db.execute(f'UPDATE messages SET {change} WHERE id = ?', row)
    db.commit()
    db.close()
    stamps = read(path)[0]['imu', 'stamp_ns']
    assert whole - 8 <= len(stamps) < whole
    assert (np.diff(stamps) > 0).all()
