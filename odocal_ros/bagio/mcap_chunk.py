# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A chunk of an mcap file, unpacked (mcap.dev/spec#chunk-op0x06), and what it says checked."""

import struct
from typing import NamedTuple
import zlib

from odocal_ros.bagio.mcap_records import CHUNK_HEAD, text_at
from odocal_ros.messages.raws import Bytes
from odocal_ros.outside.limits import Allowance, Damaged, LimitReached

CHUNK_DAMAGED = 'a damaged chunk'


class Chunk(NamedTuple):
    """
    Where its records lie, the times it states, and the message index behind it, to be proved.

    ``data`` may hold more than ``data[at:stop]``: several chunks that were read in one go.
    """

    data: Bytes
    at: int
    stop: int
    start_ns: int
    end_ns: int
    begins: Bytes = b''

    @property
    def records(self) -> memoryview:
        """Return its records."""
        return memoryview(self.data)[self.at:self.stop]


def unpacked(data: Bytes, at: int, stop: int, allowance: Allowance, cut: bool = False) -> Chunk:
    """
    Return the chunk that a record holds; or Damaged.

    at, stop : where in the data the record's content lies.   cut : the file ends in it.
    """
    body = memoryview(data)[at:stop]
    try:
        start_ns, end_ns, size, crc = CHUNK_HEAD.unpack_from(body)
        packing, place = text_at(body, CHUNK_HEAD.size)
        (length,) = struct.unpack_from('<Q', body, place)
        packed = body[place + 8:place + 8 + length]
        records = allowance.unpack(packing, packed, size)
    except (LimitReached, MemoryError):
        raise
    except Exception:    # each compression has its own error; what is lost is lost
        raise Damaged(CHUNK_DAMAGED) from None
    if not cut and (len(records) != size or crc and zlib.crc32(records) != crc):
        raise Damaged(CHUNK_DAMAGED)
    if packing:
        return Chunk(records, 0, len(records), start_ns, end_ns)
    return Chunk(data, at + place + 8, at + place + 8 + len(records), start_ns, end_ns)
