"""Records of mcap files (mcap.dev/spec): their kinds, and what stands in them."""

from collections.abc import Iterator
import struct
from typing import NamedTuple

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS = 2, 3, 4, 5, 6, 8, 11
USED = {SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS}
MOST_CUT = 2**26        # bytes taken of a chunk that the file ends in
RECORD, MESSAGE_HEAD, CHUNK_HEAD = (struct.Struct(s) for s in ('<BQ', '<HIQQ', '<QQQI'))
INDEX_HEAD = struct.Struct('<QQQQ')
END = 9 + 20 + len(MAGIC)      # of the footer


class Place(NamedTuple):
    """A chunk by the index: its times, where its record stands, whose messages it holds."""

    start_ns: int
    end_ns: int
    at: int
    size: int
    channels: frozenset[int]


def records_of(data, at: int = 0) -> Iterator[tuple[int, bytes, bool]]:
    """Yield the records of a section, up to the footer, and whether they are whole."""
    while at + 9 <= len(data):
        op, size = RECORD.unpack(data[at:at + 9])
        if op == FOOTER:
            return
        stop = at + 9 + size
        whole = stop <= len(data)
        if op in USED and whole or op == CHUNK:      # the last chunk too where the file is cut off
            yield op, data[at + 9:min(stop, at + 9 + MOST_CUT) if not whole else stop], whole
        at = stop


def place_of(body: bytes) -> Place:
    """Return the chunk that a record of the index names."""
    start_ns, end_ns, at, size = INDEX_HEAD.unpack_from(body)
    (length,) = struct.unpack_from('<I', body, INDEX_HEAD.size)
    pairs = body[INDEX_HEAD.size + 4:INDEX_HEAD.size + 4 + length]
    return Place(start_ns, end_ns, at, size,
                 frozenset(key for key, _ in struct.iter_unpack('<HQ', pairs)))


def statistics_of(body: bytes) -> tuple[int, int, int, dict[int, int]]:
    """Return the number of messages, their first and last time, and the number by channel."""
    count, *_, start_ns, end_ns, length = struct.unpack_from('<QHIIIIQQI', body)
    return count, start_ns, end_ns, dict(struct.iter_unpack('<HQ', body[46:46 + length]))


def text_at(body: bytes, at: int) -> tuple[str, int]:
    """Return a text of a record and where it ends."""
    (size,) = struct.unpack_from('<I', body, at)
    return body[at + 4:at + 4 + size].decode(), at + 4 + size
