# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Damage wherever it lies, the first chunk and the first record too: what is sound is read."""

import shutil
import sqlite3
import zlib

import numpy as np
import pytest
import ros_bags

from odocal_ros.bagio.mcap_file import McapFile
from odocal_ros.bagio.mcap_records import CHUNK
from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.sqlite_file import SqliteFile
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadBag, BadData
from odocal_ros.messages.decode import make_reader
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.slow
SLOTS = {'/imu/data': 'imu', '/odometer': 'odometer', '/fix': 'fix'}


def read(path):
    """Return the IMU's rows and the notes of a bag."""
    with open_bag(path) as bag:
        recorder = LegRecorder()
        bag.read({topic: make_reader(slot, bag.topics[topic].msgtype, Config())
                  for topic, slot in SLOTS.items() if topic in bag.topics}, recorder.feed)
        return recorder.rows('imu'), bag.notes


def chunks_of(data):
    """Return where the chunk records of an mcap file stand, and their sizes."""
    at, found = 8, []
    while data[at] != 0x02:
        size = int.from_bytes(data[at + 1:at + 9], 'little')
        if data[at] == CHUNK:
            found.append((at, size + 9))
        at += 9 + size
    return found


@pytest.fixture(scope='module', params=['none', 'storage'])
def mcap(request, tmp_path_factory):
    return ros_bags.write(tmp_path_factory.mktemp('mcap') / 'bag', ros_bags.drive(40.0), 'mcap',
                          request.param)


@pytest.mark.parametrize('where', ['record', 'length', 'head', 'name', 'data'])
@pytest.mark.parametrize('which', [0, 1])
def test_a_chunk_that_is_damaged_costs_itself(tmp_path, mcap, which, where):
    path = shutil.copytree(mcap, tmp_path / 'bag')
    whole, _ = read(path)
    data = bytearray((path / 'bag.mcap').read_bytes())
    at, size = chunks_of(data)[which]
    place = at + {'record': 0, 'length': 3, 'head': 25, 'name': 37, 'data': size // 2}[where]
    data[place:place + 8] = bytes(b ^ 0xA5 for b in data[place:place + 8])
    (path / 'bag.mcap').write_bytes(data)
    rows, notes = read(path)
    assert 0 < len(rows.stamp_ns) < len(whole.stamp_ns) or where == 'data'
    assert set(rows.stamp_ns.tolist()) <= set(whole.stamp_ns.tolist())
    assert (np.diff(rows.stamp_ns) > 0).all()      # none twice
    assert [n.code for n in notes] == [Code.BAG_TRUNCATED] * len(notes)
    assert notes or where == 'data'       # eight bytes of one value show only by a checksum


def test_a_bag_without_a_sound_chunk_is_refused(tmp_path, mcap):
    path = shutil.copytree(mcap, tmp_path / 'bag')
    data = bytearray((path / 'bag.mcap').read_bytes())
    for at, size in chunks_of(data):
        data[at + size // 2] ^= 0xA5
        data[at + 33:at + 37] = b'crc!'
    (path / 'bag.mcap').write_bytes(data)
    with pytest.raises(BadBag, match=r'cannot be read \(a damaged chunk\); copy it'):
        read(path)


def test_a_checksum_finds_what_nothing_else_shows(tmp_path, mcap):
    path = shutil.copytree(mcap, tmp_path / 'bag')
    with open_bag(path) as bag:
        part, = bag._parts
        assert isinstance(part._file, McapFile)
    data = bytearray((path / 'bag.mcap').read_bytes())
    at, size = chunks_of(data)[0]
    packed = at + 9 + 28 + 4 + int.from_bytes(data[at + 37:at + 41], 'little') + 8
    if data[at + 37]:
        pytest.skip('packed: any change shows')
    crc = zlib.crc32(data[packed:at + size])
    data[at + 33:at + 37] = crc.to_bytes(4, 'little')
    data[packed + (size - 50) // 2] ^= 1
    (path / 'bag.mcap').write_bytes(data)
    assert 'a damaged chunk' in read(path)[1][0].text


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3', 'rosbag1'])
def test_a_few_bytes_anywhere(tmp_path, storage):
    """Nothing but the errors that a door shows; whatever is read is a part of the whole."""
    rng = np.random.default_rng(7)
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(4.0), storage)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != '.yaml')
    whole = file.read_bytes()
    said = []
    for _ in range(60):
        data = bytearray(whole)
        first = rng.random() < 0.3        # where reading starts
        for place in rng.integers(0, 4200 if first else len(data), rng.integers(1, 9)):
            data[place] = rng.integers(0, 256)
        file.write_bytes(data)
        try:
            read(path)
        except (BadBag, BadData) as error:
            said.append(str(error))
    assert len(said) < 60
    assert not any('\n' in text for text in said)


def test_a_database_that_is_being_written_is_refused(tmp_path):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(2.0), 'sqlite3') / 'bag.db3'
    file = SqliteFile(path)
    rows = file.messages({'/imu/data': 'sensor_msgs/msg/Imu'})
    next(rows)
    with sqlite3.connect(path) as db:
        db.execute('INSERT INTO messages (topic_id, timestamp, data) '
                   'SELECT topic_id, timestamp + 1, data FROM messages')
    with pytest.raises(BadBag, match='changes while it is read; stop the recorder first'):
        list(rows)
    file.close()


def test_a_database_whose_rows_are_no_messages(tmp_path):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(2.0), 'sqlite3')
    whole, _ = read(path)
    db = sqlite3.connect(path / 'bag.db3')
    imu, = db.execute("SELECT id FROM topics WHERE name = '/imu/data'").fetchone()
    rows = [row for row, in db.execute('SELECT id FROM messages WHERE topic_id = ?', (imu,))]
    for row, change in zip(rows, ("data = 'text'", 'data = 17', 'data = NULL',
                                  "timestamp = 'noon'", 'timestamp = 9223372036854775807',
                                  'timestamp = -5', "topic_id = 'x'", 'topic_id = 99'),
                           strict=False):
        try:
            db.execute(f'UPDATE messages SET {change} WHERE id = ?', (row,))
        except sqlite3.IntegrityError:
            continue
    db.commit()
    db.close()
    found, _ = read(path)
    assert len(whole.stamp_ns) - 8 <= len(found.stamp_ns) < len(whole.stamp_ns)
    assert (np.diff(found.stamp_ns) > 0).all()
