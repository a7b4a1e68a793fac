# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Write mcap files (mcap.dev/spec) chunk by chunk, for the journal of the node.

It needs no rosbags. A file is complete and on the disk when ``write_file`` returns.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
import struct
from typing import Any, NamedTuple
import zlib

import numpy as np

from odocal_ros.bagio import mcap_records as mcap
from odocal_ros.bagio.bag_file import Channel
from odocal_ros.safe_io.atomic_files import whole_file, WholeFile
from odocal_ros.safe_io.limits import zstd_module

HEADER, DATA_END = 1, 15      # format: opcodes not in mcap_records: mcap.dev/spec
# a message record up to the message: opcode, size, channel, sequence number, bag and publish time
MESSAGE_RECORD = struct.Struct('<BQHIQQ')


@dataclass(frozen=True, eq=False)
class PackedChunk:
    """Messages of one channel in the form of the file."""

    channel: int
    start_ns: int
    end_ns: int
    count: int
    record: bytes      # the chunk
    index: bytes       # the message index that follows it

    @property
    def size(self) -> int:
        return len(self.record) + len(self.index)


def pack(channel: int, times_ns: Sequence[int], raws: Sequence[bytes],
         sequence: int = 0) -> PackedChunk:
    """Return messages of a channel (one or more) as a chunk, numbered from ``sequence``."""
    parts: list[bytes] = []
    for number, (time_ns, raw) in enumerate(zip(times_ns, raws, strict=True), sequence):
        parts += (MESSAGE_RECORD.pack(mcap.MESSAGE, mcap.MESSAGE_HEAD.size + len(raw), channel,
                                      number & 0xFFFFFFFF, time_ns, time_ns), raw)
    records = b''.join(parts)
    lengths = np.array([len(raw) for raw in raws]) + MESSAGE_RECORD.size
    entries = np.empty((len(raws), 2), '<u8')
    entries[:, 0] = times_ns
    entries[:, 1] = np.cumsum(lengths) - lengths
    compression, packed = _packed(records)
    start_ns, end_ns = min(times_ns), max(times_ns)
    body = (mcap.CHUNK_HEAD.pack(start_ns, end_ns, len(records), zlib.crc32(records))
            + _text(compression) + struct.pack('<Q', len(packed)) + packed)
    index = struct.pack('<HI', channel, entries.nbytes) + entries.tobytes()
    return PackedChunk(channel, start_ns, end_ns, len(raws), _record(mcap.CHUNK, body),
                       _record(mcap.MESSAGE_INDEX, index))


@cache
def _zstd() -> Any:
    try:
        return zstd_module()
    except ModuleNotFoundError:    # comes with rosbags; without it chunks are just larger
        return None


def _packed(records: bytes) -> tuple[str, bytes]:
    zstd = _zstd()
    level = 1    # a third of the size for 1 % of a core
    return ('zstd', zstd.compress(records, level)) if zstd else ('', records)


class Written(NamedTuple):
    """A written file: bytes, first and last time, messages by channel."""

    size: int
    start_ns: int
    end_ns: int
    counts: Counter[int]


def write_file(path: Path, channels: Mapping[int, Channel],
               chunks: Iterable[PackedChunk]) -> Written:
    """Write a file completely to the disk, or raise OSError and leave no part of it."""
    with whole_file(path) as file:
        return _fill(file, channels, chunks)


def _fill(file: WholeFile, channels: Mapping[int, Channel],
          chunks: Iterable[PackedChunk]) -> Written:
    definitions = b''.join(      # a schema and a channel of the same number for each topic
        _record(mcap.SCHEMA, struct.pack('<H', number) + _text(channel.msgtype)
                + _text('ros2msg' if channel.definition[0] else '') + _text(channel.definition[1]))
        + _record(mcap.CHANNEL, struct.pack('<HH', number, number) + _text(channel.topic)
                  + _text(channel.serialization) + struct.pack('<I', 0))
        for number, channel in channels.items())
    header = _record(HEADER, _text('ros2') + _text('odocal_ros'))
    offset = file.write(mcap.MAGIC + header + definitions)
    indexes, counts, start_ns, end_ns = [], Counter(dict.fromkeys(channels, 0)), 2**63 - 1, 0
    for chunk in chunks:
        indexes.append(_chunk_index(chunk, offset))
        offset += file.write(chunk.record)
        offset += file.write(chunk.index)
        counts[chunk.channel] += chunk.count
        start_ns, end_ns = min(start_ns, chunk.start_ns), max(end_ns, chunk.end_ns)
    end = _record(DATA_END, struct.pack('<I', 0))
    by_channel = b''.join(struct.pack('<HQ', *item) for item in counts.items())
    # messages, schemas, channels, attachments, metadata, chunks
    statistics = mcap.STATISTICS_HEAD.pack(
        counts.total(), len(channels), len(channels), 0, 0, len(indexes), start_ns, end_ns,
        len(by_channel)) + by_channel
    summary = definitions + _record(mcap.STATISTICS, statistics) + b''.join(indexes)
    footer = struct.pack('<QQI', offset + len(end), 0, 0)
    offset += file.write(end + summary + _record(mcap.FOOTER, footer) + mcap.MAGIC)
    return Written(offset, start_ns, end_ns, counts)


def _chunk_index(chunk: PackedChunk, offset: int) -> bytes:
    """Return the index record of a chunk at an offset of the file."""
    head = mcap.RECORD.size
    _, _, size, _ = mcap.CHUNK_HEAD.unpack_from(chunk.record, head)
    compression, end = mcap.text_at(chunk.record, head + mcap.CHUNK_HEAD.size)
    (packed_size,) = struct.unpack_from('<Q', chunk.record, end)
    return _record(mcap.CHUNK_INDEX, struct.pack(
        '<QQQQIHQQ', chunk.start_ns, chunk.end_ns, offset, len(chunk.record), 10, chunk.channel,
        offset + len(chunk.record), len(chunk.index)) + _text(compression)
        + struct.pack('<QQ', packed_size, size))


def read_chunks(path: Path) -> Iterator[PackedChunk]:
    """Yield the chunks of a file that ``write_file`` wrote, one at a time."""
    with path.open('rb') as file:
        file.seek(len(mcap.MAGIC))
        chunk = b''
        while head := file.read(mcap.RECORD.size):
            op, size = mcap.RECORD.unpack(head)
            if op == DATA_END:
                return
            record = head + file.read(size)
            if op == mcap.CHUNK:
                chunk = record
            elif op == mcap.MESSAGE_INDEX:      # it follows its chunk
                channel, index_bytes = struct.unpack_from('<HI', record, mcap.RECORD.size)
                start_ns, end_ns = mcap.TIMES.unpack_from(chunk, mcap.RECORD.size)
                yield PackedChunk(channel, start_ns, end_ns, index_bytes // 16, chunk, record)


def _record(op: int, body: bytes) -> bytes:
    return mcap.RECORD.pack(op, len(body)) + body


def _text(text: str) -> bytes:
    raw = text.encode()
    return struct.pack('<I', len(raw)) + raw
