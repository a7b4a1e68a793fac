# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A sqlite3 bag, read by SQL; from its leaf pages where those above them are damaged."""

from collections.abc import Iterator, Mapping
from pathlib import Path
import sqlite3
import struct
from typing import Any
from urllib.parse import quote

from odocal_ros.bagio.channels import Channel, FORMATS, possible, Recording
from odocal_ros.bagio.sqlite_leaves import Leaves
from odocal_ros.errors import BadBag
from odocal_ros.outside.limits import Damaged, factor, MESSAGE

READS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ}
TABLES = {'messages', 'topics', 'message_definitions'}
AS_STORED = 'SELECT rowid, topic_id, timestamp, data FROM messages ORDER BY rowid'
# sorts numbers of rows, not rows with all their data; without LIMIT sqlite ignores that order
BY_TIME = ('SELECT m.rowid, topic_id, timestamp, data FROM (SELECT rowid AS row FROM messages '
           'ORDER BY timestamp LIMIT -1) CROSS JOIN messages AS m ON m.rowid = row')
TEXTS = ('name', 'type', 'serialization_format')


class SqliteFile(Recording):
    """
    A database of messages.

    Only plain tables are read: views, functions and other content of a schema never run. The size
    of the file limits the steps that sqlite takes for a query.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._opened = path.stat()
        self._size = self._opened.st_size
        self._leaves: Leaves | None = None
        self._sorted = True
        self._db = sqlite3.connect(f'file:{quote(str(path.resolve()))}?mode=ro&immutable=1',
                                   uri=True, check_same_thread=False)
        try:
            self._guard()
            self._open()
        except BaseException:
            self.close()
            raise

    def _guard(self) -> None:
        """Let sqlite only read rows of tables, each no larger than file and limit."""
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
        """Read the topics and count the messages."""
        kinds = dict(self._query('SELECT name, type FROM sqlite_master'))
        views = [name for name in TABLES & kinds.keys() if kinds[name] != 'table']
        if views:
            raise Damaged(f'{", ".join(sorted(views))}: no table')
        definitions = self._definitions()
        self._channels = {
            key: Channel(topic, msgtype, 0, form, definitions.get(msgtype, ('', '')))
            for key, topic, msgtype, form in self._query(
                f'SELECT id, {", ".join(TEXTS)} FROM topics')
            if isinstance(key, int) and all(isinstance(x, str) for x in (topic, msgtype, form))}
        try:
            self._count()
        except Damaged as error:
            self._to_leaves(error)
            self._count()

    def _definitions(self) -> dict[str, tuple[str, str]]:
        try:
            rows = list(self._query('SELECT topic_type, encoding, encoded_message_definition '
                                    'FROM message_definitions'))
        except Damaged:
            return {}
        return {msgtype: (FORMATS.get(form, ''), text) for msgtype, form, text in rows
                if all(isinstance(x, str) for x in (msgtype, form, text))}

    def _to_leaves(self, error: Damaged) -> None:
        """Continue with the leaf pages: inner pages, which SQL needs, are damaged or missing."""
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
            if key in self._channels and possible(time_ns):
                self._sorted &= time_ns >= before
                before = time_ns
                yield key, time_ns

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Yield the messages of some topics (name -> type) by time; as written where damaged."""
        wanted, last = self._wanted(topics), -1
        if not self._leaves:
            try:
                for row, key, time_ns, raw in self._query(AS_STORED if self._sorted else BY_TIME):
                    if key in wanted and possible(time_ns):
                        # text and numbers are no messages: readers count what is none
                        yield wanted[key], time_ns, raw if isinstance(raw, bytes) else b''
                    last = row
                self._refuse_if_changed()
                return
            except Damaged as error:
                self._refuse_if_changed()
                self._to_leaves(error)
                self._count()
        assert self._leaves
        for key, time_ns, raw in self._leaves.rows(wanted, last if self._sorted else -1):
            if possible(time_ns):
                yield wanted[key], time_ns, raw

    def _refuse_if_changed(self) -> None:
        """Raise BadBag if the file was written since it was opened: SQL may see a mixture."""
        now, then = self.path.stat(), self._opened
        if (now.st_size, now.st_mtime_ns) != (then.st_size, then.st_mtime_ns):
            raise BadBag(f'{self.path}: the file changes while it is read; stop the recorder '
                         'first')

    def close(self) -> None:
        """Close the file."""
        self._db.close()
        if self._leaves:
            self._leaves.close()


