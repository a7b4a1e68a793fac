# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading mcap by columns and message by message: identical bytes, or identical errors."""

import random
import shutil
import sqlite3

import cases
from lz4 import frame
import mutations
import numpy as np
import pytest
import ros_bags
from ros_bags import T0
import ros_messages as make

from odocal_ros.bagio import mcap_columns, mcap_write
from odocal_ros.bagio.bag_file import Channel
from odocal_ros.bagio.mcap_file import McapFile
from odocal_ros.bagio.read import open_bag
from odocal_ros.errors import OdocalError

pytestmark = pytest.mark.slow
MUTATED = 40       # bags in each run
MCAPS = ['mcap', 'zstd', 'messages', 'journal']


def read(path):
    """Return topics, times and messages, and notes of a bag, or the error."""
    found = {}
    try:
        with open_bag(path) as bag:
            for batch in bag._batches(bag.topics):
                for topic, (times, raws) in batch.items():
                    found.setdefault(topic, []).extend(zip(times.tolist(), raws, strict=True))
            return bag.topics, found, bag.notes, bag.start_ns, bag.end_ns
    except OdocalError as error:
        return found, str(error)


def both(path, monkeypatch):
    by_columns = read(path)
    with monkeypatch.context() as patch:
        patch.setattr(mcap_columns, '_columns_by_index', lambda *_: None)
        return by_columns, read(path)


@pytest.fixture(scope='module')
def clean(tmp_path_factory):
    return cases.bases(tmp_path_factory.mktemp('clean'))


@pytest.fixture
def walked(monkeypatch):
    """Return a list with one entry per chunk that is scanned record by record."""
    count = []
    given = McapFile._messages_by_scan
    monkeypatch.setattr(
        McapFile, '_messages_by_scan', lambda *args: count.append(1) or given(*args))
    return count


def test_both_readers_agree_on_recorded_bags(data_dir, monkeypatch):
    bags = {p.parent for p in data_dir.rglob('*.mcap')}
    assert len(bags) > 6
    for path in sorted(bags):
        by_columns, one_by_one = both(path, monkeypatch)
        assert by_columns == one_by_one, path


@pytest.mark.parametrize('name', MCAPS)
def test_both_readers_agree_on_simulated_bags(clean, monkeypatch, name):
    by_columns, one_by_one = both(clean.bag(name), monkeypatch)
    assert by_columns == one_by_one
    assert sum(map(len, by_columns[1].values())) > 2000


@pytest.mark.parametrize('form', ['zstd', 'lz4', ''])
@pytest.mark.parametrize('lengths', [1, 7])
def test_both_readers_agree_on_overlapping_chunks(tmp_path, monkeypatch, walked, form, lengths):
    monkeypatch.setattr(mcap_columns, 'BLOCK_BYTES', 4000)
    if form != 'zstd':
        monkeypatch.setattr(mcap_write, '_packed', lambda records: (
            form, frame.compress(records) if form else records))
    rng = np.random.default_rng(1)
    channels = {k: Channel(f'/t{k}', 'std_msgs/msg/String') for k in (3, 9, 500)}
    packed, sent = [], {}
    for k in range(60):
        key = (3, 9, 500)[k % 3]
        times = (T0 + 100 * k + rng.integers(0, 400, 30)).tolist()     # not in order either
        raws = [b'\0\1\0\0' + rng.bytes(int(n)) for n in rng.integers(9, 9 + lengths, 30)]
        packed.append(mcap_write.pack(key, times, raws))
        sent.setdefault(f'/t{key}', []).append((min(times), list(zip(times, raws, strict=True))))
    mcap_write.write_file(tmp_path / 'bag.mcap', channels, packed)
    (_, found, *_), one_by_one = both(tmp_path / 'bag.mcap', monkeypatch)
    assert found == one_by_one[1]
    for topic, parts in sent.items():
        in_turn = [row for _, some in sorted(parts, key=lambda part: part[0]) for row in some]
        assert found[topic] == sorted(in_turn, key=lambda row: row[0])


def test_undamaged_chunks_are_not_scanned_record_by_record(clean, walked):
    with open_bag(clean.bag('mcap')) as bag:
        messages = sum(len(raws) for batch in bag._batches(bag.topics)
                       for _, raws in batch.values())
    assert messages > 2000
    assert len(walked) <= 1


@pytest.mark.parametrize('large', [False, True])
@pytest.mark.parametrize('indexed', [False, True])
def test_rows_of_a_database_are_read_in_any_size_and_order(tmp_path, large, indexed):
    rng = np.random.default_rng(5)
    rows = [('/t', T0 + int(rng.integers(0, 50)), b'\0\1\0\0' + rng.bytes(int(n)))
            for n in rng.integers(0, 60_000 if large else 400, 700)]
    path = ros_bags.write(tmp_path / 'bag', rows, 'sqlite3', types={'/t': 'std_msgs/msg/String'})
    db = sqlite3.connect(path / 'bag.db3')
    db.execute('DELETE FROM messages WHERE id % 7 = 0')
    db.commit()
    if not indexed:
        db.execute('DROP INDEX timestamp_idx')
    db.execute('DELETE FROM messages WHERE id % 11 = 0')
    db.execute('UPDATE messages SET timestamp = 5 WHERE id % 13 = 0')
    db.commit()
    wanted = db.execute('SELECT timestamp, data FROM messages ORDER BY timestamp, id').fetchall()
    db.close()
    assert read(path)[1]['/t'] == wanted


@pytest.mark.parametrize('another', [True, False], ids=['of another', 'of none'])
def test_both_readers_agree_on_a_wrong_message_index(tmp_path, monkeypatch, walked, another):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(60.0))
    file = path / 'bag.mcap'
    data = bytearray(file.read_bytes())
    records, at = [], 8
    while data[at] != 2:
        size = int.from_bytes(data[at + 1:at + 9], 'little')
        records.append((data[at], at))
        at += 9 + size
    rng = np.random.default_rng(3)
    for op, at in records:
        if op == 7:                     # a message index: a wrong place, among right ones
            place = at + 15 + 16 * int(rng.integers(1, 20)) + 8
            data[place:place + 8] = (data[place - 16:place - 8] if another else
                                     int(rng.integers(0, 2**20)).to_bytes(8, 'little'))
    file.write_bytes(data)
    by_columns, one_by_one = both(path, monkeypatch)
    assert by_columns == one_by_one
    assert walked
    assert by_columns[2] == ()          # no message is lost


def test_both_readers_agree_on_mutated_bags(clean, tmp_path, monkeypatch):
    rng = random.Random(20261123)
    read = 0
    for number in range(MUTATED):
        name = rng.choice(MCAPS)
        bag = tmp_path / 'bag'
        shutil.copytree(clean.bag(name), bag)
        change = rng.choice(mutations.OF.get(name) or mutations.OF[cases.BASES[name][0]])
        change(rng, bag)
        by_columns, one_by_one = both(bag, monkeypatch)
        assert by_columns == one_by_one, (number, name, change.__name__)
        read += len(by_columns) > 2
        shutil.rmtree(bag)
    assert read > MUTATED / 3


def test_both_readers_agree_on_types_with_many_layouts(tmp_path, monkeypatch):
    rows = [('/odometer', T0 + i, make.joints(T0 + i, ['a' * (1 + i % 5)], [float(i)]))
            for i in range(300)]
    path = ros_bags.write(tmp_path / 'bag', rows)
    by_columns, one_by_one = both(path, monkeypatch)
    assert by_columns == one_by_one
