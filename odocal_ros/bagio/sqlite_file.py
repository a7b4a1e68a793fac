# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A sqlite3 file of a bag, read by SQL, or from its leaf pages if the pages above them are damaged.

A table of sqlite is a tree of pages (sqlite.org/fileformat2): its rows are in the leaf pages; the
other pages only refer to them, so that rows can be found without them.
"""

from collections.abc import Callable, Container, Iterator, Mapping
from functools import partial
from pathlib import Path
import sqlite3
import struct
from typing import Any
from urllib.parse import quote

from odocal_ros.bagio.bag_file import BagFile, Channel, FileBytes, FORMATS, is_valid_time
from odocal_ros.errors import BadBag
from odocal_ros.safe_io.limits import Allowance, Damaged, limit_factor, MESSAGE_BYTES

LEAF = 0x0D                       # format: kind of page of rows, sqlite.org/fileformat2
COLUMNS = 4      # format: of rosbag2, id (NULL: it is the row number), topic_id, timestamp, data
# format: bytes of an integer, by the type code in a row
INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
READS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ}
TABLES = {'messages', 'topics', 'message_definitions'}
ROWS_AS_WRITTEN = 'SELECT rowid, topic_id, timestamp, data FROM messages ORDER BY rowid'
# sorts row numbers, not rows with their data; without LIMIT sqlite ignores that order
ROWS_BY_TIME = ('SELECT m.rowid, topic_id, timestamp, data FROM (SELECT rowid AS row FROM '
                'messages ORDER BY timestamp LIMIT -1) CROSS JOIN messages AS m ON m.rowid = row')
TOPIC_COLUMNS = ('name', 'type', 'serialization_format')


class LeafPages:
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
        self.is_truncated = len(self._map) < struct.unpack_from('>I', head, 28)[0] * self._size
        found = ((self._first_row(page), page) for page in range(1, pages))
        self._pages = [page for row, page in sorted((r, p) for r, p in found if r is not None)]

    def _first_row(self, page: int) -> int | None:
        """Return the number of the first row of a page of messages, None for other pages."""
        offset = page * self._size
        is_leaf = self._map[offset:offset + 1] == bytes([LEAF])
        return next((row for row, *_ in self._rows_of(page)), None) if is_leaf else None

    def rows(self, topic_ids: Container[int] | None, last: int = -1
             ) -> Iterator[tuple[int, int, bytes]]:
        """
        Yield (topic_id, timestamp, data) of some topics in the order of writing.

        topic_ids : None: all topics, without data.   last : rows up to this one are skipped.
        """
        # bytes that all rows together can have: large rows do not share overflow pages
        remaining_bytes = 2 * len(self._map)
        for page in self._pages:
            for row, topic_id, time_ns, payload in self._rows_of(page):
                if row <= last:              # a stale copy of a page has earlier rows
                    continue
                data = b''
                if topic_ids is not None and topic_id in topic_ids:
                    try:
                        data = payload()
                    except (ValueError, IndexError, struct.error):
                        continue             # its overflow pages are missing
                    remaining_bytes -= len(data)
                    if remaining_bytes < 0:
                        return
                last = row
                if topic_ids is None or topic_id in topic_ids:
                    yield topic_id, time_ns, data

    def _rows_of(self, page: int) -> Iterator[tuple[int, int, int, Callable[..., Any]]]:
        """Yield (row, topic_id, timestamp, function that returns the data) of a page."""
        data = self._map[page * self._size:(page + 1) * self._size]
        count = struct.unpack_from('>H', data, 3)[0]
        for i in range(min(count, (self._size - 8) // 2)):
            try:
                offset = struct.unpack_from('>H', data, 8 + 2 * i)[0]
                size, offset = _varint(data, offset)
                row, offset = _varint(data, offset)
                topic_id, time_ns, skip = _record(data, offset)
            except (ValueError, IndexError, struct.error):
                continue                     # not a row of messages
            yield row, topic_id, time_ns, partial(self._payload, data, offset, size, skip)

    def _payload(self, data: bytes, offset: int, size: int, skip: int) -> bytes:
        """Return a row of ``size`` bytes at an offset of a page, without the first ``skip``."""
        if size > min(len(self._map), MESSAGE_BYTES * limit_factor()):
            raise ValueError('larger than the file')
        # the part of a row in its page (fileformat2, 1.6: X, M, K); the rest is in a chain of
        # overflow pages, each of which begins with the number of the next
        largest = self._usable - 35
        if size <= largest:
            return data[offset:offset + size][skip:]
        smallest = (self._usable - 12) * 32 // 255 - 23
        local = smallest + (size - smallest) % (self._usable - 4)
        local = local if local <= largest else smallest
        parts, length = [data[offset:offset + local]], local
        page = struct.unpack_from('>I', data, offset + local)[0]
        while length < size:
            start = (page - 1) * self._size
            if page < 2 or start + self._size > len(self._map):
                raise ValueError('overflow page missing')
            overflow = self._map[start:start + self._usable]
            page = struct.unpack_from('>I', overflow)[0]
            parts.append(overflow[4:4 + size - length])
            length += len(parts[-1])
        return b''.join(parts)[skip:]

    def close(self) -> None:
        self._map.close()


def _record(data: bytes, offset: int) -> tuple[int, int, int]:
    """Return topic, time and offset of the data in a row of messages; ValueError if not one."""
    # a row is a header, which has its length and a type code for each column, then the values
    length, position = _varint(data, offset)
    if length > 10 * COLUMNS:      # a varint has nine bytes at most
        raise ValueError('not a message')
    codes = []
    while position < offset + length:
        code, position = _varint(data, position)
        codes.append(code)
    is_blob = len(codes) == COLUMNS and codes[3] >= 12 and codes[3] % 2 == 0
    if not is_blob or codes[0] or codes[1] not in INTEGERS or codes[2] not in INTEGERS:
        raise ValueError('not a message')
    values = []
    position = offset + length
    for code in codes[1:3]:
        size = INTEGERS[code]
        values.append(int.from_bytes(data[position:position + size], 'big', signed=True)
                      if size else code - 8)      # codes 8 and 9 are the values 0 and 1
        position += size
    return values[0], values[1], position - offset


def _varint(data: bytes, offset: int) -> tuple[int, int]:
    """Return the integer of variable length (fileformat2, 1.6) at an offset, and its end."""
    value = 0
    for i in range(8):
        byte = data[offset + i]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, offset + i + 1
    return value << 8 | data[offset + 8], offset + 9


class SqliteFile(BagFile):
    """
    A database of messages.

    Only plain tables are read: views, functions and other content of a schema never run. The size
    of the file limits the steps that sqlite takes for a query.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        super().__init__(path, allowance)
        self._opened = path.stat()
        self._size = self._opened.st_size
        self._leaf_pages: LeafPages | None = None
        self._sorted = True
        self._db = sqlite3.connect(f'file:{quote(str(path.resolve()))}?mode=ro&immutable=1',
                                   uri=True, check_same_thread=False)
        try:
            self._restrict_sqlite()
            self._open()
        except BaseException:
            self.close()
            raise

    def _restrict_sqlite(self) -> None:
        """Restrict sqlite to reading rows of tables, each no larger than file and limit."""
        db = self._db
        db.text_factory = lambda raw: raw.decode(errors='replace')
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH,
                    min(max(self._size, 100_000), int(min(MESSAGE_BYTES * limit_factor(), 2**30))))
        # without it, sqlite refuses a file that is shorter than stated in its header
        db.execute('PRAGMA writable_schema=ON')
        db.execute('PRAGMA trusted_schema=OFF')
        db.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in READS
                          else sqlite3.SQLITE_DENY)

    def _query(self, sql: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, or raise Damaged."""
        steps = 10_000    # of sqlite's virtual machine between two checks of their number
        # for any file, plus a number for each byte: reading a row of ten bytes takes about 30
        checks_left = int((20_000_000 + 20 * self._size) * limit_factor()) // steps

        def stop() -> bool:
            nonlocal checks_left
            checks_left -= 1
            return checks_left < 0
        self._db.set_progress_handler(stop, steps)
        try:
            for row in self._db.execute(sql, values):  # noqa: UP028 that would close the cursor
                yield row
        except sqlite3.Error as error:
            raise Damaged('damaged pages' if checks_left >= 0 else
                          'its tables contain a cycle') from error
        except (OverflowError, ValueError) as error:
            raise Damaged('damaged pages') from error

    def _open(self) -> None:
        kinds = dict(self._query('SELECT name, type FROM sqlite_master'))
        views = [name for name in TABLES & kinds.keys() if kinds[name] != 'table']
        if views:
            raise Damaged(f'{", ".join(sorted(views))}: no table')
        definitions = self._definitions()
        self._channels = {
            topic_id: Channel(topic, msgtype, 0, form, definitions.get(msgtype, ('', '')))
            for topic_id, topic, msgtype, form in self._query(
                f'SELECT id, {", ".join(TOPIC_COLUMNS)} FROM topics')
            if isinstance(topic_id, int)
            and all(isinstance(x, str) for x in (topic, msgtype, form))}
        try:
            self._count()
        except Damaged as error:
            self._use_leaf_pages(error)
            self._count()

    def _definitions(self) -> dict[str, tuple[str, str]]:
        try:
            rows = list(self._query('SELECT topic_type, encoding, encoded_message_definition '
                                    'FROM message_definitions'))
        except Damaged:
            return {}
        return {msgtype: (FORMATS.get(form, ''), text) for msgtype, form, text in rows
                if all(isinstance(x, str) for x in (msgtype, form, text))}

    def _use_leaf_pages(self, error: Damaged) -> None:
        """Switch to the leaf pages: inner pages, which SQL needs, are damaged or missing."""
        try:
            self._leaf_pages = LeafPages(self.path)
        except (ValueError, struct.error, IndexError) as second:
            raise Damaged(f'{error}; {second}') from None
        self.damage = 'cut off' if self._leaf_pages.is_truncated else str(error)

    def _scan(self) -> Iterator[tuple[int, int]]:
        rows: Iterator[tuple[Any, ...]] = (
            self._leaf_pages.rows(None) if self._leaf_pages
            else self._query('SELECT topic_id, timestamp, NULL FROM messages'))
        before = -1
        for topic_id, time_ns, _ in rows:
            if topic_id in self._channels and is_valid_time(time_ns):
                self._sorted &= time_ns >= before
                before = time_ns
                yield topic_id, time_ns

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Yield the messages of some topics (name -> type) by time; as written if damaged."""
        channels, last = self._channels_of(topics), -1
        if not self._leaf_pages:
            try:
                sql = ROWS_AS_WRITTEN if self._sorted else ROWS_BY_TIME
                for row, topic_id, time_ns, raw in self._query(sql):
                    if topic_id in channels and is_valid_time(time_ns):
                        # text and numbers are not messages: readers count b'' as unreadable
                        yield channels[topic_id], time_ns, raw if isinstance(raw, bytes) else b''
                    last = row
                self._refuse_if_changed()
                return
            except Damaged as error:
                self._refuse_if_changed()
                self._use_leaf_pages(error)
                self._count()
        assert self._leaf_pages
        skipped = last if self._sorted else -1
        for topic_id, time_ns, raw in self._leaf_pages.rows(channels, skipped):
            if is_valid_time(time_ns):
                yield channels[topic_id], time_ns, raw

    def _refuse_if_changed(self) -> None:
        """Raise BadBag if the file was written since it was opened: SQL may see a mixture."""
        now, then = self.path.stat(), self._opened
        if (now.st_size, now.st_mtime_ns) != (then.st_size, then.st_mtime_ns):
            raise BadBag(f'{self.path}: the file changes while it is read; stop the recorder '
                         'first')

    def close(self) -> None:
        self._db.close()
        if self._leaf_pages:
            self._leaf_pages.close()
