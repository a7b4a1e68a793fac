# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Records of mcap files (mcap.dev/spec): their kinds and content; chunks unpacked and checked."""

from collections.abc import Iterator, Sequence
from operator import attrgetter
import struct
from typing import NamedTuple
import zlib

from odocal_ros.bagio.bag_file import FileBytes
from odocal_ros.messages.raws import Bytes
from odocal_ros.safe_io.limits import Allowance, Damaged, LimitReached

MAGIC = b'\x89MCAP0\r\n'
# format: opcodes of the records, mcap.dev/spec
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS = (
    2, 3, 4, 5, 6, 7, 8, 11)
USED = {SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS}
INDEX_DAMAGED = 'a damaged index'
CHUNK_DAMAGED = 'a damaged chunk'
MOST_CUT = 2**26        # judgement: bytes used of a chunk that is truncated by the end of the file
RECORD, MESSAGE_HEAD, CHUNK_HEAD = (struct.Struct(s) for s in ('<BQ', '<HIQQ', '<QQQI'))
INDEX_HEAD, TIMES = struct.Struct('<QQQQ'), struct.Struct('<QQ')
FOOTER_SIZE = 9 + 20 + len(MAGIC)      # format: of the footer


class ChunkIndex(NamedTuple):
    """
    Index entry of a chunk: times, position of its record, channels.

    index_size : bytes of the message index after the chunk, limited by ``ordered_chunks`` to the
    space before the next chunk.   unpacked_size : bytes, as stated.
    """

    start_ns: int
    end_ns: int
    at: int
    size: int
    channels: frozenset[int]
    index_size: int = 0
    unpacked_size: int = 0


def records_of(data: bytes | FileBytes, at: int = 0) -> Iterator[tuple[int, bytes, bool]]:
    """Yield the records of a section, up to the footer: op, content, True if complete."""
    while at + 9 <= len(data):
        op, size = RECORD.unpack(data[at:at + 9])
        if op == FOOTER:
            return
        stop = at + 9 + size
        complete = stop <= len(data)
        if op in USED and complete or op == CHUNK:      # also a truncated last chunk
            yield op, data[at + 9:min(stop, at + 9 + MOST_CUT) if not complete else stop], complete
        at = stop


def chunk_index_of(body: bytes) -> ChunkIndex:
    """Return the chunk described by a record of the index."""
    start_ns, end_ns, at, size = INDEX_HEAD.unpack_from(body)
    (length,) = struct.unpack_from('<I', body, INDEX_HEAD.size)
    stop = INDEX_HEAD.size + 4 + length
    pairs = body[INDEX_HEAD.size + 4:stop]
    return ChunkIndex(start_ns, end_ns, at, size,
                      frozenset(key for key, _ in struct.iter_unpack('<HQ', pairs)),
                      int.from_bytes(body[stop:stop + 8], 'little'),
                      int.from_bytes(body[-8:], 'little'))


def ordered_chunks(chunks: Sequence[ChunkIndex], end: int) -> list[ChunkIndex]:
    """
    Return the chunks of an index in order of time.

    Raises Damaged if they overlap in the file or exceed ``end``: they could unpack to any size.
    """
    chunks, found, at = sorted(chunks, key=attrgetter('at')), [], len(MAGIC)
    for chunk, after in zip(chunks, [*(c.at for c in chunks[1:]), end], strict=True):
        if chunk.at < at or chunk.size < 9 or chunk.at + chunk.size > end:
            raise Damaged(INDEX_DAMAGED)
        at = chunk.at + chunk.size
        found.append(chunk._replace(index_size=min(chunk.index_size, max(after - at, 0))))
    return sorted(found)


def statistics_of(body: bytes) -> tuple[int, int, int, dict[int, int]]:
    """Return the number of messages, their first and last time, and the number by channel."""
    count, *_, start_ns, end_ns, length = struct.unpack_from('<QHIIIIQQI', body)
    return count, start_ns, end_ns, dict(struct.iter_unpack('<HQ', body[46:46 + length]))


def text_at(body: Bytes, at: int) -> tuple[str, int]:
    """Return the text at an offset of a record, and the offset after it."""
    (size,) = struct.unpack_from('<I', body, at)
    return bytes(body[at + 4:at + 4 + size]).decode(), at + 4 + size


class Chunk(NamedTuple):
    """
    Position of its records, stated times, and the message index after it, unverified.

    ``data`` may contain more than ``data[at:stop]``: several chunks that were read at once.
    """

    data: Bytes
    at: int
    stop: int
    start_ns: int
    end_ns: int
    message_index: Bytes = b''

    @property
    def records(self) -> memoryview:
        return memoryview(self.data)[self.at:self.stop]


def unpack_chunk(data: Bytes, at: int, stop: int, allowance: Allowance,
                 cut: bool = False) -> Chunk:
    """
    Return the chunk of a record, or raise Damaged.

    at, stop : of the record's content in the data.   cut : it is truncated by the end of the file.
    """
    body = memoryview(data)[at:stop]
    try:
        start_ns, end_ns, size, crc = CHUNK_HEAD.unpack_from(body)
        packing, offset = text_at(body, CHUNK_HEAD.size)
        (length,) = struct.unpack_from('<Q', body, offset)
        packed = body[offset + 8:offset + 8 + length]
        records = allowance.unpack(packing, packed, size)
    except (LimitReached, MemoryError):
        raise
    except Exception:    # each compression has its own error
        raise Damaged(CHUNK_DAMAGED) from None
    if not cut and (len(records) != size or crc and zlib.crc32(records) != crc):
        raise Damaged(CHUNK_DAMAGED)
    if packing:
        return Chunk(records, 0, len(records), start_ns, end_ns)
    return Chunk(data, at + offset + 8, at + offset + 8 + len(records), start_ns, end_ns)
