# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that demand too much time or memory give one error message, within limits of both."""

from contextlib import closing
import os
import sqlite3
import struct
import sys
import time
import tracemalloc

import pytest
import ros_bags
from ros_bags import T0

from odocal_ros.bagio import rosbags_readers
from odocal_ros.bagio.mcap_records import MAGIC
from odocal_ros.bagio.read import open_bag
from odocal_ros.errors import BadBag, BadData
from odocal_ros.safe_io.limits import FACTOR_VARIABLE, zstd_module

MEMORY_LIMIT = 2**28       # bytes: a quarter of the additional memory that a reading may use


def record(op, body):
    return struct.pack('<BQ', op, len(body)) + body


def text(what):
    return struct.pack('<I', len(what)) + what.encode()


def zeros(mebibytes):
    """Return zstd data of so many MiB of zeros: 1 GiB is 32 kB."""
    packer = zstd_module().ZstdCompressor()
    return b''.join([packer.compress(bytes(2**20)) for _ in range(mebibytes)]) + packer.flush()


def mcap(path, packed, size, times=1, index=True):
    """Write an mcap file whose index names one chunk many times."""
    described = (record(3, struct.pack('<H', 1) + text('sensor_msgs/msg/Imu') + text('ros2msg')
                        + text(''))
                 + record(4, struct.pack('<HH', 1, 1) + text('/imu') + text('cdr') + bytes(4)))
    head = MAGIC + record(1, text('ros2') + text('x')) + described
    chunk = record(6, struct.pack('<QQQI', 1, 9, size, 0) + text('zstd')
                   + struct.pack('<Q', len(packed)) + packed)
    entry = record(8, struct.pack('<QQQQIHQQ', 1, 9, len(head), len(chunk), 10, 1, 0, 0)
                   + text('zstd') + struct.pack('<QQ', len(packed), size))
    statistics = record(11, struct.pack('<QHIIIIQQIHQ', 5, 1, 1, 0, 0, times, 1, 9, 10, 1, 5))
    data = head + chunk + record(15, bytes(4))
    footer = struct.pack('<QQI', len(data) if index else 0, 0, 0)
    path.write_bytes(data + (described + statistics + entry * times) * index
                     + record(2, footer) + MAGIC)
    return path


def database(folder, *lines, rows=None, types=None):
    """Write a bag, change its database by lines of SQL with their values, and return it."""
    path = ros_bags.write(folder / 'bag', rows or ros_bags.drive(0.5), 'sqlite3', types=types)
    with closing(sqlite3.connect(path / 'bag.db3')) as db, db:
        for line, *values in lines:
            db.execute(line, values)
    return path


def peak_memory_and_error(path):
    """Open a bag and read a topic; return its peak memory, bytes, and the error, '' if none."""
    tracemalloc.start()
    error_text = ''
    try:
        with open_bag(path) as bag:
            for _ in bag.messages(next(iter(bag.topics))):
                pass
    except (BadBag, BadData) as error:
        error_text = str(error)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak, error_text


@pytest.fixture(scope='module')
def bomb():
    return zeros(2048)


@pytest.mark.parametrize('kind', ['chunk', 'scan', 'file', 'message'])
def test_a_stream_that_decompresses_to_2_gib_is_refused(tmp_path, bomb, kind):
    path = tmp_path / 'bag.mcap'
    if kind == 'file':
        path.write_bytes(bomb)
    elif kind == 'message':
        path = ros_bags.write(tmp_path / 'bag', [('/imu', T0, bomb)], 'sqlite3',
                              types={'/imu': 'sensor_msgs/msg/Imu'})
    else:
        mcap(path, bomb, 2**31, index=kind == 'chunk')
    peak, error_text = peak_memory_and_error(path)
    assert peak < MEMORY_LIMIT
    assert 'unpacked, it exceeds the limit of' in error_text
    assert f'set {FACTOR_VARIABLE}=10' in error_text


def test_the_limit_can_be_raised(tmp_path, monkeypatch):
    path = tmp_path / 'bag.mcap'
    packed = zeros(100)
    mcap(path, packed, 100 * 2**20)
    assert peak_memory_and_error(path)[1]
    monkeypatch.setenv(FACTOR_VARIABLE, '10')
    assert 'exceeds the limit of' not in peak_memory_and_error(path)[1]


def test_a_chunk_that_the_index_names_many_times_is_counted_once(tmp_path):
    message = record(5, struct.pack('<HIQQ', 1, 0, 5, 5))
    packed = zstd_module().compress(message * 100_000)
    path = mcap(tmp_path / 'bag.mcap', packed, 3_100_000, times=1000)
    with open_bag(path) as bag:
        assert bag.topics['/imu'].count == 100_000      # once


@pytest.mark.parametrize('sql', [
    ['CREATE VIEW {t} AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT '
     'x AS id, 1 AS topic_id, x AS timestamp, zeroblob(100000000) AS data, x AS topic_type, x AS '
     'encoding, x AS encoded_message_definition, x AS name, x AS type, x AS serialization_format '
     'FROM c'],
    ['CREATE TABLE {t} (id INTEGER PRIMARY KEY, topic_id, timestamp, data GENERATED ALWAYS AS '
     '(zeroblob(900000000)), name, type, serialization_format, topic_type, encoding, '
     'encoded_message_definition GENERATED ALWAYS AS (zeroblob(900000000)))',
     'INSERT INTO {t} (topic_id, timestamp) VALUES (1, 5)']])
@pytest.mark.parametrize('table', ['messages', 'topics', 'message_definitions'])
def test_a_database_schema_that_generates_rows_stays_within_the_memory_limit(tmp_path, table, sql):
    lines = [f'ALTER TABLE {table} RENAME TO before', *(line.format(t=table) for line in sql)]
    path = database(tmp_path, *((line,) for line in lines))
    assert peak_memory_and_error(path)[0] < MEMORY_LIMIT


def test_overflow_pages_in_a_loop_stay_within_the_memory_limit(tmp_path):
    path = database(tmp_path, *[('INSERT INTO messages (topic_id, timestamp, data) VALUES '
                                 '(1, ?, zeroblob(200000))', T0)] * 3)
    file = path / 'bag.db3'
    data = bytearray(file.read_bytes())
    size = int.from_bytes(data[16:18], 'big')
    loops = 0
    for page in range(1, len(data) // size):
        at = page * size
        if data[at:at + 4] == (page + 2).to_bytes(4, 'big') and not any(data[at + 4:at + size]):
            data[at:at + 4] = (page + 1).to_bytes(4, 'big')
            loops += 1
    assert loops > 10
    file.write_bytes(data)
    assert peak_memory_and_error(path)[0] < MEMORY_LIMIT


DEFINITIONS = {
    'array': ('ros2msg', 'string[100000000] x\n'),
    'arrays in arrays': ('ros2msg', 'b/C[1000] x\n' + '=' * 80 + '\nMSG: b/C\nint8[1000] y\n'),
    'idl array': ('ros2idl', 'module a { module msg { const long N = 100000000; '
                             'struct B { string x[N]; }; }; };'),
    'computed': ('ros2idl', 'module a { module msg { const long N = 1 << 10000000000; '
                            'struct B { string x[N]; }; }; };'),
    'long': ('ros2msg', '\n'.join(f'int32 x{i}' for i in range(20_000))),
    'deep': ('ros2idl', 'module a { module msg { const long N = ' + '(' * 500 + '1' + ')' * 500
             + '; struct B { long x; }; }; };'),
    'itself': ('ros2msg', 'a/B x\n')}


@pytest.mark.parametrize('kind', DEFINITIONS)
def test_a_huge_or_recursive_definition_is_refused(tmp_path, kind, monkeypatch):
    monkeypatch.setattr('odocal_ros.safe_io.limits.PARSE_SECONDS', 3)
    peak, error_text = peak_memory_and_error(database(
        tmp_path, ("UPDATE topics SET type = 'a/msg/B'",),
        ("UPDATE message_definitions SET topic_type = 'a/msg/B', encoding = ?, "
         'encoded_message_definition = ?', *DEFINITIONS[kind]),
        rows=[('/x', T0, b'\0\1\0\0' + bytes(40))], types={'/x': 'std_msgs/msg/String'}))
    assert peak < MEMORY_LIMIT
    assert 'exceeds the limit of' in error_text or 'cannot be parsed' in error_text


def test_annotations_of_a_definition_are_skipped():
    strings = '"a (b" ' * 20_000
    text = (f'module a {{ module msg {{ @verbatim(text={strings}) '
            '@x struct B { @y(z=(1)) long x; /* ( */ }; }; };')
    found = rosbags_readers.parse_definition('a/msg/B', 'idl', text)
    assert [name for name, _ in found['a/msg/B'][1]] == ['x']


def test_devices_and_pipes_are_not_read(tmp_path):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(0.5))
    os.mkfifo(path / 'x.mcap')
    (path / 'metadata.yaml').unlink()
    (path / 'metadata.yaml').symlink_to('/dev/zero')
    with open_bag(path) as bag:
        assert len(bag.files) == 1
        assert 'not a regular file' in bag.notes[0]
    for one in (path / 'x.mcap', '/dev/zero'):
        with pytest.raises(BadBag, match='not a regular file'), open_bag(one):
            pass


def test_the_decompressor_is_searched_once_not_for_each_message(tmp_path, monkeypatch):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(1.0), 'mcap', 'message')
    searched = []

    class Finder:
        @staticmethod
        def find_spec(name, *_):
            searched.append(name)
    zstd_module.cache_clear()
    monkeypatch.setattr(sys, 'meta_path', [Finder, *sys.meta_path])
    with open_bag(path) as bag:
        assert len(list(bag.messages('/imu/data'))) == 100
    assert len([name for name in searched if name.startswith('compression')]) <= 2


@pytest.mark.parametrize('kind', ['chunk', 'file'])
def test_many_empty_frames_are_refused_within_2_s(tmp_path, kind):
    frames = zstd_module().compress(b'') * 100_000        # 0.9 MB
    path = tmp_path / 'bag.mcap'
    if kind == 'file':
        path.write_bytes(frames)
    else:
        mcap(path, frames, 100)
    before = time.process_time()
    _, error_text = peak_memory_and_error(path)
    assert time.process_time() - before < 2.0
    assert 'frames; if the file is valid' in error_text


def metadata(folder, change):
    """Write a bag and change the tree of its metadata.yaml."""
    path = ros_bags.write(folder / 'bag', ros_bags.drive(0.5), 'mcap')
    file = path / 'metadata.yaml'
    file.write_text(change(file.read_text()))
    return path


def test_nested_yaml_aliases_are_not_expanded(tmp_path):
    links = ['&l0 [x, x, x, x, x, x, x, x]']
    links += [f'&l{k} [{", ".join([f"*l{k - 1}"] * 8)}]' for k in range(1, 8)]
    odd = '{' + ', '.join(f'k{k}: {link}' for k, link in enumerate(links)) + '}'
    path = metadata(tmp_path, lambda text: text.replace('serialization_format: cdr',
                                                        f'serialization_format: {odd}', 1))
    assert 'k7' in (path / 'metadata.yaml').read_text()
    assert peak_memory_and_error(path)[0] < MEMORY_LIMIT
    merges = ['a0: &m0 {x: 1}'] + [
        f'a{k}: &m{k} {{<<: [{", ".join([f"*m{k - 1}"] * 8)}]}}' for k in range(1, 9)]
    path = metadata(tmp_path / 'merged', lambda text: '\n'.join([*merges, text]))
    assert peak_memory_and_error(path)[0] < MEMORY_LIMIT


@pytest.mark.parametrize(('text', 'what'), [
    ('#' * 2**22, 'bytes'), (''.join(f'k{n}: {n}\n' for n in range(38_000)), 'values')])
def test_metadata_that_are_too_long_or_have_too_many_keys_are_not_used(tmp_path, text, what):
    path = metadata(tmp_path, lambda content: content + text)
    with open_bag(path) as bag:
        assert any('exceeds the limit of' in note and what in note for note in bag.notes)


@pytest.mark.parametrize('link', ['hardlink_to', 'symlink_to', 'same name'])
def test_a_file_with_many_names_is_read_once(tmp_path, link):
    path = ros_bags.write(tmp_path / 'bag', ros_bags.drive(0.5), 'mcap')
    names = [file.name for file in path.iterdir() if file.suffix == '.mcap']
    assert len(names) == 1
    for k in range(50 * (link != 'same name')):
        getattr(path / f'more_{k}.mcap', link)(path / names[0])
    text = (path / 'metadata.yaml').read_text()
    line = next(x for x in text.split('\n') if x.strip().startswith('- bag'))
    more = [line if link == 'same name' else line.replace(names[0], f'more_{k}.mcap')
            for k in range(50)]
    (path / 'metadata.yaml').write_text(text.replace(line, '\n'.join([line, *more]), 1))
    with open_bag(path) as bag:
        assert len(bag.files) == 1
    (path / 'metadata.yaml').unlink()
    with open_bag(path) as bag:
        assert len(bag.files) == 1


def test_the_size_of_one_message_of_a_database_is_limited(tmp_path):
    line = 'UPDATE messages SET data = zeroblob(200000000) WHERE rowid = 3'
    assert peak_memory_and_error(database(tmp_path, (line,)))[0] < 2**27
