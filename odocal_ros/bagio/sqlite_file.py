# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A sqlite3 bag: by SQL, or from the pages of its leaves where SQL comes upon damage."""

from collections.abc import Iterator, Mapping
from pathlib import Path
import sqlite3
import struct
from typing import Any
from urllib.parse import quote

import numpy as np

from odocal_ros.bagio import sqlite_gather
from odocal_ros.bagio.channels import Batch, Channel, FORMATS, Message, possible, Recording
from odocal_ros.bagio.file_bytes import FileBytes
from odocal_ros.bagio.sqlite_leaves import Leaves
from odocal_ros.errors import BadBag
from odocal_ros.outside.limits import Damaged, factor, LATEST_NS, MESSAGE

READS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ}
TABLES = {'messages', 'topics', 'message_definitions'}
BY_TIME = 'SELECT rowid FROM messages ORDER BY timestamp'
TEXTS = ('name', 'type', 'serialization_format')


class SqliteFile(Recording):
    """
    A database of messages.

    Only plain tables are read: views, functions and what else a schema may hold never run. What
    sqlite does for a query is bounded by the size of the file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._size = path.stat().st_size
        self._leaves: Leaves | None = None
        self._sorted = True
        self._rows: sqlite_gather.Rows | None = None
        self._file = FileBytes(path)
        self._db = sqlite3.connect(f'file:{quote(str(path.resolve()))}?mode=ro&immutable=1',
                                   uri=True, check_same_thread=False)
        try:
            self._guard()
            self._open()
        except BaseException:
            self.close()
            raise

    def _guard(self) -> None:
        """Let sqlite do no more than read rows of tables, each no larger than file and limit."""
        db = self._db
        db.text_factory = lambda raw: raw.decode(errors='replace')
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH,
                    min(max(self._size, 100_000), int(min(MESSAGE * factor(), 2**30))))
        # else sqlite refuses at once a file shorter than its header says
        db.execute('PRAGMA writable_schema=ON')
        db.execute('PRAGMA trusted_schema=OFF')
        db.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in READS
                          else sqlite3.SQLITE_DENY)

    def _query(self, sql: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, or raise Damaged."""
        steps = 10_000    # of sqlite's machine between two looks at how many it took
        # for any file, and more for each byte: a row of ten takes about 30 to read
        left = int((20_000_000 + 20 * self._size) * factor()) // steps

        def stop() -> bool:
            nonlocal left
            left -= 1
            return left < 0
        self._db.set_progress_handler(stop, steps)
        try:
            for row in self._db.execute(sql, values):  # noqa: UP028 that would close the cursor
                yield row
        except sqlite3.Error as error:
            raise Damaged('damaged pages' if left >= 0 else
                          'its tables contain a cycle') from error
        except (OverflowError, ValueError) as error:
            raise Damaged('damaged pages') from error

    def _open(self) -> None:
        """Learn the topics and count the messages."""
        kinds = dict(self._query("SELECT name, type || ' ' || rootpage FROM sqlite_master"))
        views = [name for name in TABLES & kinds.keys() if not kinds[name].startswith('table ')]
        if views:
            raise Damaged(f'{", ".join(sorted(views))}: no table')
        definitions = self._definitions()
        self._channels = {
            key: Channel(topic, msgtype, 0, form, definitions.get(msgtype, ('', '')))
            for key, topic, msgtype, form in self._query(
                f'SELECT id, {", ".join(TEXTS)} FROM topics')
            if isinstance(key, int) and all(isinstance(x, str) for x in (topic, msgtype, form))}
        try:
            if not self._indexed():
                self._count()
        except Damaged as error:
            self._to_leaves(error)
            self._count()

    def _indexed(self) -> bool:
        """Learn from the pages where all messages lie; False: that is for SQL."""
        rows = None
        for sql, root in self._query(
                "SELECT sql, rootpage FROM sqlite_master WHERE name = 'messages'"):
            rows = sqlite_gather.rows_of(self._file, root) if sqlite_gather.plain(sql) else None
        if rows is None:
            return False
        known = np.isin(rows.key, list(self._channels))
        self._rows = rows = rows.take(
            known & (rows.time_ns >= 0) & (rows.time_ns < LATEST_NS))
        self._sorted = bool((np.diff(rows.time_ns) >= 0).all())
        counts = zip(*(column.tolist() for column in np.unique(rows.key, return_counts=True)),
                     strict=True)
        self._set_counts(dict(counts), int(rows.time_ns.min(initial=2**63 - 1)),
                   int(rows.time_ns.max(initial=0)))
        return True

    def _definitions(self) -> dict[str, tuple[str, str]]:
        try:
            rows = list(self._query('SELECT topic_type, encoding, encoded_message_definition '
                                    'FROM message_definitions'))
        except Damaged:
            return {}
        return {msgtype: (FORMATS.get(form, ''), text) for msgtype, form, text in rows
                if all(isinstance(x, str) for x in (msgtype, form, text))}

    def _to_leaves(self, error: Damaged) -> None:
        """Go on with the pages, as the inner ones that SQL needs are gone or wrong."""
        try:
            self._leaves = Leaves(self.path)
        except (ValueError, struct.error, IndexError) as second:
            raise Damaged(f'{error}; {second}') from None
        self.damage = 'cut off' if self._leaves.cut else str(error)

    def _scan(self) -> Iterator[tuple[int, int]]:
        rows: Iterator[tuple[Any, ...]] = self._leaves.rows(None) if self._leaves else self._query(
            'SELECT topic_id, timestamp, NULL FROM messages')
        before = -1
        for key, time_ns, _ in rows:
            if isinstance(key, int) and key in self._channels and possible(time_ns):
                self._sorted &= time_ns >= before
                before = time_ns
                yield key, time_ns

    def batches(self, topics: Mapping[str, str]) -> Iterator[Batch] | None:
        """Yield the same many at a time; None where SQL has to find some of them."""
        wanted, rows = self._wanted(topics), self._rows
        if rows is None:
            return None
        rows = rows.take(np.isin(rows.key, list(wanted)))
        if (rows.offset < 0).any():
            return None
        if not self._sorted:
            try:
                ids = np.fromiter((each for each, in self._query(BY_TIME)), np.int64)
            except Damaged:
                return None
            where = np.searchsorted(rows.id, ids)
            there = where < len(rows.id)
            where = where[there]
            rows = rows.take(where[rows.id[where] == ids[there]])
        return self._gathered(rows, wanted)

    def _gathered(self, rows: sqlite_gather.Rows, wanted: Mapping[int, Channel]
                  ) -> Iterator[Batch]:
        try:
            yield from sqlite_gather.batches(self._file, rows, wanted)
        except sqlite_gather.Odd:
            raise BadBag(f'{self.path}: the file changes while it is read; stop the recorder first'
                         ) from None

    def messages(self, topics: Mapping[str, str]) -> Iterator[Message]:
        """Yield the messages of some topics (name -> type) by time; as written where damaged."""
        wanted, last = self._wanted(topics), -1
        if not self._leaves:
            try:
                for row, key, time_ns, raw in self._by_time():
                    if isinstance(key, int) and key in wanted and possible(time_ns):
                        # text and numbers are no messages: readers count what is none
                        yield Message(wanted[key], time_ns, raw if isinstance(raw, bytes) else b'')
                    last = row
                return
            except Damaged as error:
                self._to_leaves(error)
                self._count()
        assert self._leaves
        for key, time_ns, raw in self._leaves.rows(wanted, last if self._sorted else -1):
            if possible(time_ns):
                yield Message(wanted[key], time_ns, raw)

    def _by_time(self) -> Iterator[tuple[Any, ...]]:
        row = 'SELECT rowid, topic_id, timestamp, data FROM messages'
        if self._sorted:
            yield from self._query(f'{row} ORDER BY rowid')
            return
        # one by one: sqlite would sort them with all their data
        order = [each for each, in self._query(BY_TIME)]
        for each in order:
            yield from self._query(f'{row} WHERE rowid = ?', each)

    def close(self) -> None:
        """Let go of the file."""
        self._db.close()
        self._file.close()
        if self._leaves:
            self._leaves.close()


