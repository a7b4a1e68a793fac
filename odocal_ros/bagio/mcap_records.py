# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Parts of an mcap file (mcap.dev/spec): records, chunks, index and statistics as Python values.

In: bytes of an untrusted file. Out: their content; ``Damaged`` is raised for invalid bytes.
"""

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
INDEX_DAMAGED = 'invalid index'
CHUNK_DAMAGED = 'invalid chunk'
MAX_TRUNCATED = 2**26    # judgement: bytes used of a chunk that the end of the file truncates
RECORD = struct.Struct('<BQ')               # before each record: opcode, size of its content
# first fields of the content of records
MESSAGE_HEAD = struct.Struct('<HIQQ')       # channel, sequence number, bag time, publish time
CHUNK_HEAD = struct.Struct('<QQQI')         # start, end, unpacked size, checksum
INDEX_HEAD = struct.Struct('<QQQQ')         # of a chunk: start, end, offset, size of its record
STATISTICS_HEAD = struct.Struct('<QHIIIIQQI')   # counts, start, end, bytes of further counts
TIMES = struct.Struct('<QQ')                # start and end of a chunk
FOOTER_SIZE = RECORD.size + 20 + len(MAGIC)     # format: bytes of the footer record and the magic


Entry = tuple[int, int, bytes]     # bag time, ns, channel number, message


class ChunkIndex(NamedTuple):
    """Entry of a chunk in the index, as stated; offset and size are those of its record, bytes."""

    start_ns: int
    end_ns: int
    offset: int
    size: int
    channels: frozenset[int]
    index_size: int = 0      # of the message index after the chunk; ``ordered_chunks`` limits it
    unpacked_size: int = 0


def records_of(data: bytes | FileBytes, offset: int = 0) -> Iterator[tuple[int, bytes, bool]]:
    """Yield the records of a section, up to the footer: op, content, True if complete."""
    while (begin := offset + RECORD.size) <= len(data):      # of the content
        op, size = RECORD.unpack(data[offset:begin])
        if op == FOOTER:
            return
        offset = begin + size
        is_complete = offset <= len(data)
        if op in USED and is_complete or op == CHUNK:      # also a truncated last chunk
            end = offset if is_complete else min(offset, begin + MAX_TRUNCATED)
            yield op, data[begin:end], is_complete


def chunk_index_of(body: bytes) -> ChunkIndex:
    """Return the chunk described by a record of the index."""
    start_ns, end_ns, offset, size = INDEX_HEAD.unpack_from(body)
    (length,) = struct.unpack_from('<I', body, INDEX_HEAD.size)
    stop = INDEX_HEAD.size + 4 + length
    pairs = body[INDEX_HEAD.size + 4:stop]
    return ChunkIndex(start_ns, end_ns, offset, size,
                      frozenset(number for number, _ in struct.iter_unpack('<HQ', pairs)),
                      int.from_bytes(body[stop:stop + 8], 'little'),
                      int.from_bytes(body[-8:], 'little'))


def ordered_chunks(chunks: Sequence[ChunkIndex], end: int) -> list[ChunkIndex]:
    """
    Return the chunks of an index in order of time.

    Raises Damaged if they overlap in the file or exceed ``end``: they could unpack to any size.
    """
    chunks, valid, offset = sorted(chunks, key=attrgetter('offset')), [], len(MAGIC)
    for chunk, next_offset in zip(chunks, [*(c.offset for c in chunks[1:]), end], strict=True):
        if chunk.offset < offset or chunk.size < RECORD.size or chunk.offset + chunk.size > end:
            raise Damaged(INDEX_DAMAGED)
        offset = chunk.offset + chunk.size
        space = max(next_offset - offset, 0)
        valid.append(chunk._replace(index_size=min(chunk.index_size, space)))
    return sorted(valid)      # by the first field, the start time


def statistics_of(body: bytes) -> tuple[int, int, int, dict[int, int]]:
    """Return the number of messages, their first and last time, and the number by channel."""
    count, *_, start_ns, end_ns, length = STATISTICS_HEAD.unpack_from(body)
    pairs = body[STATISTICS_HEAD.size:STATISTICS_HEAD.size + length]
    return count, start_ns, end_ns, dict(struct.iter_unpack('<HQ', pairs))


def text_at(body: Bytes, offset: int) -> tuple[str, int]:
    """Return the text at an offset of a record, and the offset after it."""
    (size,) = struct.unpack_from('<I', body, offset)
    return bytes(body[offset + 4:offset + 4 + size]).decode(), offset + 4 + size


class Chunk(NamedTuple):
    """A decompressed chunk and its stated times."""

    records: Bytes
    start_ns: int
    end_ns: int
    message_index: Bytes = b''   # the index after the chunk in the file, not verified


def unpack_chunk(body: Bytes, allowance: Allowance, is_truncated: bool = False) -> Chunk:
    """Return the chunk in the content of a record, or raise Damaged."""
    try:
        start_ns, end_ns, size, crc = CHUNK_HEAD.unpack_from(body)
        compression, offset = text_at(body, CHUNK_HEAD.size)
        (length,) = struct.unpack_from('<Q', body, offset)
        packed = memoryview(body)[offset + 8:offset + 8 + length]
        records = allowance.unpack(compression, packed, size)
    except (LimitReached, MemoryError):
        raise
    except Exception:    # each compression has its own error
        raise Damaged(CHUNK_DAMAGED) from None
    if not is_truncated and (len(records) != size or crc and zlib.crc32(records) != crc):
        raise Damaged(CHUNK_DAMAGED)
    return Chunk(records, start_ns, end_ns)
