# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Seeded mutations of bags, by their structure: each takes a random.Random and a folder."""

from functools import wraps
from pathlib import Path
import random
import struct

from damage import cdr, file_of, FLOATS, INTEGERS, spoil
from sqlite_mutations import sqlite_oddities, sqlite_pages, sqlite_rows, sqlite_values
import yaml

from odocal_ros.bagio.mcap_records import CHUNK, MAGIC
from odocal_ros.safe_io.limits import zstd_module

VALUES = [None, True, -1, 0, 10**400, 2**63, float('inf'), float('nan'), '', 'text', '\0',
          '\x1b[2J', '$(command x)', '../../x', '/dev/zero', 'x' * 5000, [], [[]], {}, {'a': 1},
          [None], -1e308, '9' * 5000, '1e400', '!!python/none', '*a', '[' * 3000]
NUMBERS = ['1', '-5', '1e9', '0.5', 'true', '0x10', '1e-3']
CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'calibrator.yaml'
PACKED = struct.Struct('<QQQI')


def without_checksums(rng, bag):
    """Return the file of a bag; remove the checksums of most mcap files."""
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
    """Drop, repeat, swap or damage some of a list of records."""
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


def of_records(change):
    """Return a mutation of a bag by one of the records of its file."""
    @wraps(change)
    def mutation(rng, bag):
        file = file_of(bag)
        records = change(rng, records_of(file.read_bytes(), len(MAGIC)))
        file.write_bytes(MAGIC + joined(records) + MAGIC)
    return mutation


@of_records
def mcap_records(rng, records):
    """Change records of the file, index and footer among them."""
    return some_records(rng, records)


def unindexed(records, index=(2, 7, 8, 11, 14)):
    """Return records without an index: its offsets are wrong, a reader has to work without it."""
    return [r for r in records if r[0] not in index] + [(2, bytes(20))]


def places_of(records, op):
    return [i for i, (one, _) in enumerate(records) if one == op]


@of_records
def mcap_inside(rng, records):
    """Change records or values in a chunk, and pack it again with matching sizes."""
    which = rng.choice(places_of(records, CHUNK))
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
    return unindexed(records, (2, 8, 11, 14))


INDEX = {         # places and sizes of numbers of a record
    6: [(0, 8), (8, 8), (16, 8), (24, 4)],                                      # chunk
    7: [(2, 4), (6, 8), (14, 8), (22, 8), (30, 8)],                             # message index
    8: [(0, 8), (8, 8), (16, 8), (24, 8), (32, 4), (46, 8)],                    # chunk index
    11: [(0, 8), (8, 2), (10, 4), (22, 4), (26, 8), (34, 8)], 2: [(0, 8), (8, 8), (16, 4)]}


@of_records
def mcap_lies(rng, records):
    """Make indexes, chunk headers and counts wrong: by a value of another record or a number."""
    for _ in range(rng.choice([1, 1, 3, 30])):
        op = rng.choice([k for k in INDEX if any(k == one for one, _ in records)])
        i, j = (rng.choice(places_of(records, op)) for _ in range(2))
        at, size = rng.choice(INDEX[op])
        body = bytearray(records[i][1])
        if at + size > len(body):
            continue
        number = rng.choice([
            int.from_bytes(records[j][1][at:at + size], 'little'), rng.choice(INTEGERS),
            int.from_bytes(body[at:at + size], 'little') + rng.choice([-9, -1, 1, 9, 1000])])
        body[at:at + size] = (number % 2**(8 * size)).to_bytes(size, 'little')
        records[i] = op, bytes(body)
    return records


@of_records
def mcap_overlap(rng, records):
    """Repeat or swap chunks, so that their times overlap; the index is correct or missing."""
    chunks = places_of(records, CHUNK)
    kind, i, j = rng.randrange(3), rng.choice(chunks), rng.choice(chunks)
    if kind == 0:
        records.insert(j, records[i])
    elif kind == 1:
        records[i], records[j] = records[j], records[i]
    else:                      # two index entries of the same chunk
        entries = places_of(records, 8)
        records.insert(rng.choice(entries), records[rng.choice(entries)])
    return unindexed(records) if kind < 2 else records


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
    """Change records of the file or of a chunk, or values in messages; all offsets stay."""
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
      'file': [raw, clump, metadata],                   # compressed as a whole
      'messages': [raw, clump, mcap_records, metadata]}  # each compressed
