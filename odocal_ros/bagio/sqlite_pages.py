# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The rows of the table of messages in a damaged sqlite3 file, read from its leaf pages.

A table of sqlite is a tree of pages (sqlite.org/fileformat2): its rows are in the leaf pages; the
other pages only refer to them, so that rows can be found without them.
"""

from collections.abc import Container, Iterator
from pathlib import Path
import struct
from typing import NamedTuple

from odocal_ros.bagio.bag_file import FileBytes
from odocal_ros.safe_io.limits import limit_factor, MESSAGE_BYTES

LEAF = b'\x0D'      # format: first byte of a page with rows, sqlite.org/fileformat2
# format: of rosbag2: id (NULL: it is the row number), topic_id, timestamp, data
COLUMN_COUNT = 4
# format: bytes of an integer, by the type code in a row
INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
# errors raised if the bytes are not a row, or a part of the row is missing
NO_ROW = (ValueError, IndexError, struct.error)


class Row(NamedTuple):
    """A row of the table of messages: its numbers, and where its content is."""

    number: int          # increases in the order of writing
    topic_id: int
    time_ns: int
    page: bytes          # the leaf page with the first bytes of the content
    offset: int          # of the content in the page
    size: int            # of the content, bytes: a header and the values of the columns
    data_offset: int     # of the message in the content


class LeafPages:
    """The leaf pages of the table of messages that are in the file."""

    def __init__(self, path: Path) -> None:
        self._file = FileBytes(path)
        header = self._file[:100]
        page_size, reserved_bytes = struct.unpack_from('>H2xB', header, 16)
        self._page_size = 65536 if page_size == 1 else page_size
        if self._page_size < 512:
            raise ValueError('no page size')
        self._usable_bytes = self._page_size - reserved_bytes      # of each page
        stated_pages = struct.unpack_from('>I', header, 28)[0]
        self.is_truncated = len(self._file) < stated_pages * self._page_size
        first_rows = {}      # number of the first row by index of the page
        for page in range(1, len(self._file) // self._page_size):
            offset = page * self._page_size
            if self._file[offset:offset + 1] == LEAF and (row := next(self._rows_of(page), None)):
                first_rows[page] = row.number
        self._pages = sorted(first_rows, key=lambda page: first_rows[page])

    def rows(self, topic_ids: Container[int] | None, last_row: int = -1
             ) -> Iterator[tuple[int, int, bytes]]:
        """
        Yield (topic_id, timestamp, data) of some topics in the order of writing.

        topic_ids : None: all topics, without data.   last_row : rows up to this one are skipped.
        """
        # bytes that all rows together can have: large rows do not share overflow pages
        remaining_bytes = 2 * len(self._file)
        for page in self._pages:
            for row in self._rows_of(page):
                if row.number <= last_row:   # a stale copy of a page has earlier rows
                    continue
                data = b''
                if topic_ids is not None and row.topic_id in topic_ids:
                    try:
                        data = self._data_of(row)
                    except NO_ROW:
                        continue             # its overflow pages are missing
                    remaining_bytes -= len(data)
                    if remaining_bytes < 0:
                        return
                last_row = row.number
                if topic_ids is None or row.topic_id in topic_ids:
                    yield row.topic_id, row.time_ns, data

    def _rows_of(self, index: int) -> Iterator[Row]:
        """Yield the rows of messages of a leaf page."""
        page = self._file[index * self._page_size:(index + 1) * self._page_size]
        # a page begins with 8 bytes, of which 3 and 4 are the number of rows, and the offset of
        # each row, two bytes
        count = struct.unpack_from('>H', page, 3)[0]
        for i in range(min(count, (self._page_size - 8) // 2)):
            try:
                offset = struct.unpack_from('>H', page, 8 + 2 * i)[0]
                size, offset = _varint(page, offset)
                number, offset = _varint(page, offset)
                topic_id, time_ns, data_offset = _numbers_of(page, offset)
            except NO_ROW:
                continue
            yield Row(number, topic_id, time_ns, page, offset, size, data_offset)

    def _data_of(self, row: Row) -> bytes:
        """Return the message in a row, or raise one of NO_ROW."""
        if row.size > min(len(self._file), MESSAGE_BYTES * limit_factor()):
            raise ValueError('larger than the file')
        # the first bytes of the content are in the leaf page, as many as fileformat2, 1.6, states
        # with its X, M and K; the rest is in a chain of overflow pages, each of which begins with
        # the number of the next
        largest = self._usable_bytes - 35
        if row.size <= largest:
            return row.page[row.offset:row.offset + row.size][row.data_offset:]
        smallest = (self._usable_bytes - 12) * 32 // 255 - 23
        length = smallest + (row.size - smallest) % (self._usable_bytes - 4)
        length = length if length <= largest else smallest
        parts = [row.page[row.offset:row.offset + length]]
        next_page = struct.unpack_from('>I', row.page, row.offset + length)[0]
        while length < row.size:
            start = (next_page - 1) * self._page_size      # pages are numbered from 1
            if next_page < 2 or start + self._page_size > len(self._file):
                raise ValueError('overflow page missing')
            overflow = self._file[start:start + self._usable_bytes]
            next_page = struct.unpack_from('>I', overflow)[0]
            parts.append(overflow[4:4 + row.size - length])
            length += len(parts[-1])
        return b''.join(parts)[row.data_offset:]

    def close(self) -> None:
        self._file.close()


def _numbers_of(page: bytes, offset: int) -> tuple[int, int, int]:
    """Return topic_id, timestamp and offset of the message in a row; ValueError if it is none."""
    # the header has its length and a type code for each column
    length, position = _varint(page, offset)
    if length > 10 * COLUMN_COUNT:      # a varint has nine bytes at most
        raise ValueError('not a message')
    codes = []
    while position < offset + length:
        code, position = _varint(page, position)
        codes.append(code)
    is_blob = len(codes) == COLUMN_COUNT and codes[3] >= 12 and codes[3] % 2 == 0
    if not is_blob or codes[0] or any(code not in INTEGER_BYTES for code in codes[1:3]):
        raise ValueError('not a message')
    numbers = []
    position = offset + length
    for code in codes[1:3]:
        size = INTEGER_BYTES[code]
        numbers.append(int.from_bytes(page[position:position + size], 'big', signed=True)
                       if size else code - 8)      # codes 8 and 9 are the values 0 and 1
        position += size
    return numbers[0], numbers[1], position - offset


def _varint(page: bytes, offset: int) -> tuple[int, int]:
    """Return the integer of variable length (fileformat2, 1.6) at an offset, and its end."""
    value = 0
    for i in range(8):
        byte = page[offset + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, offset + i + 1
    return value << 8 | page[offset + 8], offset + 9
