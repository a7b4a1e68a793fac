# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rows of the table ``messages`` straight from the pages of a sqlite3 file (sqlite.org/fileformat).

Only for files that sqlite itself cannot read to the end.
"""

from collections.abc import Callable, Container, Iterator
from functools import partial
from pathlib import Path
import struct
from typing import Any

from odocal_ros.bagio.file_bytes import FileBytes
from odocal_ros.outside.limits import factor, MESSAGE

LEAF = 0x0D                       # format: kind of page of rows, sqlite.org/fileformat2
# format: of rosbag2, id (NULL: it is the row number), topic_id, timestamp, data
COLUMNS = 4
INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}      # format: bytes, by serial type


class Leaves:
    """The leaf pages of the table of messages that are in the file."""

    def __init__(self, path: Path) -> None:
        self._map = FileBytes(path)
        head = self._map[:100]
        size = struct.unpack_from('>H', head, 16)[0]
        self._size = 65536 if size == 1 else size
        if self._size < 512:
            raise ValueError('no page size')
        self._usable = self._size - head[20]
        pages = len(self._map) // self._size
        self.cut = len(self._map) < struct.unpack_from('>I', head, 28)[0] * self._size
        found = ((self._first_row(page), page) for page in range(1, pages))
        self._pages = [page for row, page in sorted((r, p) for r, p in found if r is not None)]

    def _first_row(self, page: int) -> int | None:
        """Return the number of the first row of a page of messages, None for other pages."""
        at = page * self._size
        if self._map[at:at + 1] != bytes([LEAF]):
            return None
        for row, _, _, _ in self._rows_of(page):
            return row
        return None

    def rows(self, keys: Container[int] | None, last: int = -1
             ) -> Iterator[tuple[int, int, bytes]]:
        """
        Yield (topic_id, timestamp, data) of some topics in the order they were written.

        keys : topics, None: of all, without their data.   last : rows up to it are skipped.
        """
        left = 2 * len(self._map)            # bytes: no two rows share a page for large ones
        for page in self._pages:
            for row, key, time_ns, payload in self._rows_of(page):
                if row <= last:              # a stale copy of a page holds rows seen already
                    continue
                data = b''
                if keys is not None and key in keys:
                    try:
                        data = payload()
                    except (ValueError, IndexError, struct.error):
                        continue             # its overflow pages are gone
                    left -= len(data)
                    if left < 0:
                        return
                last = row
                if keys is None or key in keys:
                    yield key, time_ns, data

    def _rows_of(self, page: int) -> Iterator[tuple[int, int, int, Callable[..., Any]]]:
        """Yield (row, topic_id, timestamp, function that returns the data) of a page."""
        data = self._map[page * self._size:(page + 1) * self._size]
        count = struct.unpack_from('>H', data, 3)[0]
        for i in range(min(count, (self._size - 8) // 2)):
            try:
                at = struct.unpack_from('>H', data, 8 + 2 * i)[0]
                size, at = _varint(data, at)
                row, at = _varint(data, at)
                key, time_ns, skip = _record(data, at)
            except (ValueError, IndexError, struct.error):
                continue                     # not a row of messages
            yield row, key, time_ns, partial(self._data, data, at, size, skip)

    def _data(self, data: bytes, at: int, size: int, skip: int) -> bytes:
        return self._payload(data, at, size)[skip:]

    def _payload(self, data: bytes, at: int, size: int) -> bytes:
        """Return the bytes of a row, including its overflow pages."""
        if size > min(len(self._map), MESSAGE * factor()):
            raise ValueError('larger than the file')
        largest = self._usable - 35
        if size <= largest:
            return data[at:at + size]
        least = (self._usable - 12) * 32 // 255 - 23
        local = least + (size - least) % (self._usable - 4)
        local = local if local <= largest else least
        parts, have = [data[at:at + local]], local
        page = struct.unpack_from('>I', data, at + local)[0]
        while have < size:
            start = (page - 1) * self._size
            if page < 2 or start + self._size > len(self._map):
                raise ValueError('overflow page missing')
            whole = self._map[start:start + self._usable]
            page = struct.unpack_from('>I', whole)[0]
            parts.append(whole[4:4 + size - have])
            have += len(parts[-1])
        return b''.join(parts)

    def close(self) -> None:
        """Close the file."""
        self._map.close()


def _record(data: bytes, at: int) -> tuple[int, int, int]:
    """Return topic, time and where the data begin in a row of messages; ValueError if not one."""
    length, pos = _varint(data, at)
    if length > 10 * COLUMNS:      # a varint has nine bytes at most
        raise ValueError('not a message')
    kinds = []
    while pos < at + length:
        kind, pos = _varint(data, pos)
        kinds.append(kind)
    if (len(kinds) != COLUMNS or kinds[0] or kinds[1] not in INTEGERS or kinds[2] not in INTEGERS
            or kinds[3] < 12 or kinds[3] % 2):
        raise ValueError('not a message')
    values = []
    pos = at + length
    for kind in kinds[1:3]:
        size = INTEGERS[kind]
        values.append(int.from_bytes(data[pos:pos + size], 'big', signed=True)
                      if size else kind - 8)
        pos += size
    return values[0], values[1], pos - at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for i in range(8):
        byte = data[at + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    return value << 8 | data[at + 8], at + 9
