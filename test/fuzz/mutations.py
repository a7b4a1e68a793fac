# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Seeded mutations of bags, by their structure: each takes a random.Random and a folder."""

from contextlib import closing
from pathlib import Path
import random
import sqlite3
import struct

import yaml

from odocal_ros.bagio.mcap_records import CHUNK, MAGIC
from odocal_ros.outside.limits import zstd_module

INTEGERS = [0, 1, -1, 2, 127, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62,
            2**63 - 1, 2**63, 2**64 - 1]
FLOATS = [0.0, -0.0, 1.0, -1.0, 5e-324, 1e-310, 1e-30, 1e15, 1e200, 1e308, -1e308, float('nan'),
          float('inf'), float('-inf'), 3.14, 1e3, -100.0]
VALUES = [None, True, -1, 0, 10**400, 2**63, float('inf'), float('nan'), '', 'text', '\0',
          '\x1b[2J', '$(command x)', '../../x', '/dev/zero', 'x' * 5000, [], [[]], {}, {'a': 1},
          [None], -1e308, '9' * 5000, '1e400', '!!python/none', '*a', '[' * 3000]
NUMBERS = ['1', '-5', '1e9', '0.5', 'true', '0x10', '1e-3']
CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'calibrator.yaml'
PACKED = struct.Struct('<QQQI')


def file_of(bag):
    """Return the file of a bag that holds the messages."""
    return bag if bag.is_file() else next(f for f in sorted(bag.iterdir())
                                          if f.suffix in ('.mcap', '.db3', '.zstd'))


def some_place(rng, size):
    """Return a place in a file, near its ends more often than not."""
    kind = rng.random()
    if kind < 0.25:
        return rng.randrange(min(size, 4096))
    return size - 1 - rng.randrange(min(size, 4096)) if kind < 0.5 else rng.randrange(size)


def spoil(rng, data):
    """Change bytes anywhere: bits, numbers, runs, cuts, doubles."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        if not data:
            return data
        at = some_place(rng, len(data))
        kind = rng.randrange(7)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            form = rng.choice(['<H', '<I', '<Q', '>H', '>I', '>Q'])
            number = rng.choice(INTEGERS) % 2 ** (8 * struct.calcsize(form))
            if at + 8 <= len(data):
                struct.pack_into(form, data, at, number)
        elif kind == 2 and at + 8 <= len(data):
            struct.pack_into('<d', data, at, rng.choice(FLOATS))
        elif kind == 3:
            run = rng.choice([1, 8, 11, 64, 1000, 20_000])
            data[at:at + run] = rng.randbytes(len(data[at:at + run]))
        elif kind == 4:
            del data[at:at + rng.choice([1, 7, 100, 10_000])]
        elif kind == 5:
            data[at:at] = data[at:at + rng.choice([1, 9, 500, 20_000])]
        elif rng.random() < 0.3:
            del data[at:]
    return data


def without_checksums(rng, bag):
    """Return the file of a bag, an mcap file mostly as those have it that write no checksums."""
    file = file_of(bag)
    data = bytearray(file.read_bytes())
    if data.startswith(MAGIC) and rng.random() < 0.7:
        at = len(MAGIC)
        while data[at] != 2:
            if data[at] == CHUNK:
                data[at + 33:at + 37] = bytes(4)
            at += 9 + int.from_bytes(data[at + 1:at + 9], 'little')
        file.write_bytes(data)
    return file


def raw(rng, bag):
    """Change bytes of the file."""
    file = without_checksums(rng, bag)
    file.write_bytes(spoil(rng, file.read_bytes()))


def clump(rng, bag):
    """Overwrite a few bytes of one chunk, as a disk or a copy does."""
    file = without_checksums(rng, bag)
    data = bytearray(file.read_bytes())
    at = rng.randrange(len(data))
    for place in range(at, min(at + 400, len(data)), rng.randrange(10, 60)):
        data[place] = rng.randrange(256)
    file.write_bytes(data)


# ---- mcap ----------------------------------------------------------------------------------

def records_of(data, at=0):
    """Return (op, body) of the records of a section."""
    found = []
    while at + 9 <= len(data):
        op, size = struct.unpack_from('<BQ', data, at)
        found.append((op, bytes(data[at + 9:at + 9 + size])))
        at += 9 + size
        if op == 2:
            break
    return found


def joined(records):
    return b''.join(struct.pack('<BQ', op, len(body)) + body for op, body in records)


def some_records(rng, records):
    """Drop, double, exchange or spoil some of a list of records."""
    for _ in range(rng.choice([1, 1, 3, 10])):
        i, j = rng.randrange(len(records)), rng.randrange(len(records))
        kind = rng.randrange(6)
        if kind == 0 and len(records) > 1:
            del records[i]
        elif kind == 1:
            records.insert(j, records[i])
        elif kind == 2:
            records[i], records[j] = records[j], records[i]
        elif kind == 3:
            records[i] = (rng.randrange(256), records[i][1])
        else:
            records[i] = (records[i][0], bytes(spoil(rng, records[i][1])))
    return records


def mcap_records(rng, bag):
    """Change records of the file, index and footer among them."""
    file = file_of(bag)
    records = some_records(rng, records_of(file.read_bytes(), len(MAGIC)))
    file.write_bytes(MAGIC + joined(records) + MAGIC)


def mcap_inside(rng, bag):
    """Change records or values in a chunk and pack it anew, so that all the outside fits."""
    file = file_of(bag)
    data = file.read_bytes()
    records = records_of(data, len(MAGIC))
    chunks = [i for i, (op, _) in enumerate(records) if op == CHUNK]
    which = rng.choice(chunks)
    body = records[which][1]
    start, end, _, _ = PACKED.unpack_from(body)
    length = struct.unpack_from('<I', body, 28)[0]
    form = body[32:32 + length]
    inner = body[40 + length:]
    zstd = zstd_module()
    inner = zstd.decompress(inner) if form == b'zstd' else inner
    inside = records_of(inner)
    if rng.random() < 0.3:
        inside = some_records(rng, inside)
    else:
        share = rng.choice([0.002, 0.05, 0.05, 1.0])
        inside = [(op, cdr(rng, body, 22)) if op == 5 and rng.random() < share else (op, body)
                  for op, body in inside]
    inner = joined(inside)
    packed = zstd.compress(inner) if form == b'zstd' else inner
    records[which] = CHUNK, (PACKED.pack(start, end, len(inner), 0) + body[28:32 + length]
                             + struct.pack('<Q', len(packed)) + packed)
    # without an index: its places are no longer right, and a reader has to do without
    kept = [r for r in records if r[0] not in (2, 8, 11, 14)]
    file.write_bytes(MAGIC + joined(kept) + joined([(2, bytes(20))]) + MAGIC)


def cdr(rng, message, head=0):
    """Return a message with one of its numbers odd, or of another length; ``head`` bytes stay."""
    body = bytearray(message)
    if len(body) < head + 12 or rng.random() < 0.1:
        return bytes(body[:head] + spoil(rng, body[head:]))
    at = head + 4 + 4 * rng.randrange((len(body) - head - 8) // 4)
    if rng.random() < 0.7 and at + 8 <= len(body):
        struct.pack_into('<d', body, at, rng.choice(FLOATS))
    else:               # a time, a length of a string or a list, a status
        struct.pack_into('<I', body, rng.choice([at, head + 4, head + 8]),
                         rng.choice(INTEGERS) % 2**32)
    return bytes(body)


INDEX = {         # places and sizes of numbers of a record
    6: [(0, 8), (8, 8), (16, 8), (24, 4)],                                      # chunk
    7: [(2, 4), (6, 8), (14, 8), (22, 8), (30, 8)],                             # message index
    8: [(0, 8), (8, 8), (16, 8), (24, 8), (32, 4), (46, 8)],                    # chunk index
    11: [(0, 8), (8, 2), (10, 4), (22, 4), (26, 8), (34, 8)], 2: [(0, 8), (8, 8), (16, 4)]}


def mcap_lies(rng, bag):
    """Have indexes, heads of chunks and counts lie: as another record says it, or by a number."""
    file = file_of(bag)
    records = records_of(file.read_bytes(), len(MAGIC))
    for _ in range(rng.choice([1, 1, 3, 30])):
        op = rng.choice([k for k in INDEX if any(k == one for one, _ in records)])
        places = [i for i, (one, _) in enumerate(records) if one == op]
        i, j = rng.choice(places), rng.choice(places)
        at, size = rng.choice(INDEX[op])
        body = bytearray(records[i][1])
        if at + size > len(body):
            continue
        number = rng.choice([
            int.from_bytes(records[j][1][at:at + size], 'little'), rng.choice(INTEGERS),
            int.from_bytes(body[at:at + size], 'little') + rng.choice([-9, -1, 1, 9, 1000])])
        body[at:at + size] = (number % 2**(8 * size)).to_bytes(size, 'little')
        records[i] = op, bytes(body)
    file.write_bytes(MAGIC + joined(records) + MAGIC)


def mcap_overlap(rng, bag):
    """Repeat or exchange chunks, so that their times overlap; the index is true or is missing."""
    file = file_of(bag)
    records = records_of(file.read_bytes(), len(MAGIC))
    chunks = [i for i, (op, _) in enumerate(records) if op == CHUNK]
    kind, i, j = rng.randrange(3), rng.choice(chunks), rng.choice(chunks)
    if kind == 0:
        records.insert(j, records[i])
    elif kind == 1:
        records[i], records[j] = records[j], records[i]
    else:                      # the same chunk by two entries of the index
        entries = [k for k, (op, _) in enumerate(records) if op == 8]
        records.insert(rng.choice(entries), records[rng.choice(entries)])
    if kind < 2:
        records = [r for r in records if r[0] not in (2, 7, 8, 11, 14)] + [(2, bytes(20))]
    file.write_bytes(MAGIC + joined(records) + MAGIC)


# ---- sqlite3 -------------------------------------------------------------------------------

def sqlite_rows(rng, bag):
    """Change rows and the schema by SQL."""
    odd = ["'text'", '17', 'NULL', "x''", "x'ff'", '-1', '9223372036854775807', '1e300',
           'zeroblob(100000)', "'\x1b[2J'", 'randomblob(300)']
    db = sqlite3.connect(file_of(bag))
    tables = {'messages': ('id', 'topic_id', 'timestamp', 'data'),
              'topics': ('id', 'name', 'type', 'serialization_format', 'offered_qos_profiles'),
              'message_definitions': ('topic_type', 'encoding', 'encoded_message_definition'),
              'schema': ('schema_version',)}
    for _ in range(rng.choice([1, 2, 5])):
        table = rng.choice([*tables, 'messages', 'messages'])
        column = rng.choice(tables[table])
        share = rng.choice(['1', 'rowid % 2', f'rowid = {rng.randrange(1, 3000)}',
                            f'abs(random()) % {rng.choice([20, 300])} = 0'])
        change = rng.choice([f'UPDATE OR IGNORE {table} SET {column} = {rng.choice(odd)} '
                             f'WHERE {share}', f'DELETE FROM {table} WHERE {share}',
                             f'ALTER TABLE {table} RENAME COLUMN {column} TO x',
                             f'DROP TABLE {table}', 'DROP INDEX timestamp_idx'])
        try:
            db.execute(change)
        except sqlite3.Error:
            continue
    db.commit()
    db.close()


def sqlite_values(rng, bag):
    """Change values inside of messages, in some rows or all, and leave the table as it is."""
    with sqlite3.connect(file_of(bag)) as db:
        share = rng.choice([0.002, 0.05, 1.0])
        rows = [row for row in db.execute('SELECT id, data FROM messages') if rng.random() < share]
        db.executemany('UPDATE messages SET data = ? WHERE id = ?',
                       [(cdr(rng, data), key) for key, data in rows])
    db.close()


COLUMNS = ('id', 'topic_id', 'timestamp', 'data')
TABLES = [          # that hold the same rows in another way
    'CREATE TABLE other (data BLOB, timestamp INTEGER, topic_id INTEGER, id INTEGER PRIMARY KEY)',
    'CREATE TABLE other (id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB, '
    'PRIMARY KEY (timestamp, id)) WITHOUT ROWID',
    'CREATE TABLE other (id, topic_id, timestamp, data)',
    'CREATE TABLE other (id TEXT, topic_id TEXT, timestamp TEXT, data TEXT)',
    'CREATE TABLE other (id INTEGER PRIMARY KEY DESC, more BLOB DEFAULT (zeroblob(70000)), '
    'topic_id INTEGER, timestamp REAL, data BLOB)',
    'CREATE TABLE other (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB, '
    'twice AS (timestamp * 2) STORED)']
CHANGES = [
    'CREATE VIEW messages AS SELECT * FROM other', 'ALTER TABLE other RENAME TO messages',
    'ALTER TABLE other RENAME TO "Messages"', 'INSERT INTO messages SELECT '
    f'{", ".join(COLUMNS)} FROM other']
ROWS = ['id, topic_id, timestamp, data', '-id, topic_id, timestamp, data',
        'id + 9223372036854770000, topic_id, timestamp, data',
        "id, topic_id, timestamp, CAST(data || x'00' AS BLOB)"]


def sqlite_oddities(rng, bag):
    """Hold the rows in a table, a view or a file that other writers of sqlite may have."""
    file = file_of(bag)
    old = file.with_suffix('.old')
    file.rename(old)
    with closing(sqlite3.connect(old)) as read, (
            closing(sqlite3.connect(file, isolation_level=None))) as db:
        for pragma in (f'page_size = {rng.choice([512, 1024, 4096, 65536])}',
                       f'encoding = "{rng.choice(["UTF-8", "UTF-8", "UTF-16le", "UTF-16be"])}"',
                       f'auto_vacuum = {rng.choice([0, 1, 2])}',
                       f'journal_mode = {rng.choice(["delete", "wal"])}'):
            db.execute(f'PRAGMA {pragma}')
        db.execute('BEGIN')
        for name, sql in read.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table' "
                                      "AND name NOT LIKE 'sqlite_%'").fetchall():
            db.execute(sql)
            rows = read.execute(f'SELECT * FROM {name}').fetchall()
            if rows and name != 'messages':
                db.executemany(f'INSERT INTO {name} VALUES ({", ".join("?" * len(rows[0]))})',
                               rows)
        table, change = rng.choice(TABLES), rng.choice(CHANGES)
        if change.startswith(('ALTER', 'CREATE VIEW messages')):
            db.execute('DROP TABLE messages')
        db.execute(table)
        order = rng.choice(['timestamp', 'timestamp DESC', 'topic_id, id', 'random()'])
        db.executemany(f'INSERT OR IGNORE INTO other ({", ".join(COLUMNS)}) VALUES (?, ?, ?, ?)',
                       read.execute(f'SELECT {rng.choice([ROWS[0], *ROWS])} FROM messages ORDER '
                                    f'BY {order}'))
        db.execute(change)
        db.execute('COMMIT')
    old.unlink()


def sqlite_pages(rng, bag):
    """Change the heads of pages: kinds, cells, where they lead."""
    file = file_of(bag)
    data = bytearray(file.read_bytes())
    size = int.from_bytes(data[16:18], 'big')
    for _ in range(rng.choice([1, 3, 20])):
        page = rng.randrange(len(data) // size)
        at = page * size + (100 if page == 0 else 0) + rng.randrange(24)
        data[at] = rng.choice([0, 1, 2, 5, 10, 13, 255, rng.randrange(256)])
    file.write_bytes(data)


# ---- rosbag1 -------------------------------------------------------------------------------

def ros1_records(data, at=0):
    """Return (header, data) of the records of a file or a chunk."""
    found = []
    while at + 8 <= len(data):
        (size,) = struct.unpack_from('<I', data, at)
        (length,) = struct.unpack_from('<I', data, at + 4 + size)
        found.append((bytes(data[at + 4:at + 4 + size]),
                      bytes(data[at + 8 + size:at + 8 + size + length])))
        at += 8 + size + length
    return found


def ros1_joined(records):
    return b''.join(struct.pack('<I', len(part)) + part for record in records for part in record)


def ros1_inside(rng, bag):
    """Change records of the file or of a chunk, or values in messages; all places stay."""
    magic, rest = bag.read_bytes().split(b'\n', 1)
    records = ros1_records(rest)
    chunks = [i for i, (head, _) in enumerate(records) if b'op=\x05' in head]
    if rng.random() < 0.3 or not chunks:
        i = rng.randrange(len(records))
        parts = list(records[i])
        which = rng.randrange(2)
        parts[which] = bytes(spoil(rng, parts[which]))
        records[i] = tuple(parts)
    else:
        i, share = rng.choice(chunks), rng.choice([0.002, 0.05, 1.0])
        records[i] = records[i][0], ros1_joined(
            (head, cdr(rng, body)[:len(body)].ljust(len(body), b'\0'))
            if b'op=\x02' in head and rng.random() < share else (head, body)
            for head, body in ros1_records(records[i][1]))
    bag.write_bytes(magic + b'\n' + ros1_joined(records))


# ---- text ----------------------------------------------------------------------------------

def metadata(rng, bag):
    """Change a value, a key or the text of metadata.yaml."""
    text_file(rng, bag / 'metadata.yaml')


def linked(rng, bag):
    """Give the file of messages more names, in metadata.yaml or without it."""
    file = file_of(bag)
    names = [f'{rng.choice(["a", "z"])}_{k}{file.suffix}' for k in range(rng.choice([1, 30]))]
    for name in names:
        getattr(bag / name, rng.choice(['hardlink_to', 'symlink_to']))(file)
    about = bag / 'metadata.yaml'
    if rng.random() < 0.5:
        about.unlink()
        return
    tree = yaml.safe_load(about.read_text())
    tree['rosbag2_bagfile_information']['relative_file_paths'] += names
    about.write_text(yaml.safe_dump(tree))


def text_file(rng, file):
    """Change a value of a tree, or splice its text."""
    text = file.read_text()
    if rng.random() < 0.4:
        at = rng.randrange(len(text))
        odd = rng.choice(['[', '{', '*a ', '&a ', '!!x ', '\t', ': ', '- ', '\x00', '\n', '#', '"',
                          '9' * 400, 'é', '%', '|', '?'])
        file.write_text(text[:at] + odd + text[at + rng.choice([0, 1, 20]):])
        return
    tree = yaml.safe_load(text)
    node, owner, key = tree, None, None
    while isinstance(node, dict | list) and node and (owner is None or rng.random() < 0.8):
        owner = node
        key = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        node = node[key]
    owner[key] = rng.choice(VALUES)
    file.write_text(yaml.safe_dump(tree))


def texts(rng: random.Random, folder):
    """Return options of odd text: settings, legs, topics, a file of settings."""
    from odocal_ros.settings.config import SETTINGS
    found = []
    for _ in range(rng.choice([1, 1, 2, 4])):
        odd = rng.choice([*map(str, VALUES), *map(str, FLOATS), *NUMBERS, '[1, 2, 3]', '[]',
                          '[nan, 0, 0]', '{a: 1}', '&a [*a]'])
        kind = rng.randrange(9)
        if kind < 5:
            found += ['--set', f'{rng.choice([*SETTINGS, "no.such", ""])}={odd}']
        elif kind == 5:
            found += [f'--leg={odd}:{rng.choice(["", "60", odd])}']
        elif kind == 6:
            file = folder / 'settings.yaml'
            file.write_text(CONFIG.read_text())
            text_file(rng, file)
            found += [f'--config={file}']
        else:
            name = rng.choice(['imu', 'odometer', 'fix', 'heading', 'odometer-right'])
            found += [f'--{name}-topic={rng.choice([odd, "/imu/data", "/fix", "/odometer"])}']
    return [option.replace('\0', ' ') for option in found]


OF = {'mcap': [raw, clump, mcap_records, mcap_inside, mcap_inside, mcap_lies, mcap_overlap,
               metadata, linked],
      'sqlite3': [raw, clump, sqlite_rows, sqlite_values, sqlite_values, sqlite_oddities,
                  sqlite_pages, metadata, linked],
      'rosbag1': [raw, clump, ros1_inside, ros1_inside],
      'file': [raw, clump, metadata],                   # packed as a whole, and
      'messages': [raw, clump, mcap_records, metadata]}  # each: no value can be reached
