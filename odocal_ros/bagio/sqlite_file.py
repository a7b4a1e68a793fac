# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A sqlite3 file of a bag, read by SQL, or from its leaf pages if other pages are damaged."""

from collections.abc import Iterator, Mapping
from pathlib import Path
import sqlite3
from typing import Any
from urllib.parse import quote

from odocal_ros.bagio.bag_file import BagFile, Channel, FORMATS, is_valid_time
from odocal_ros.bagio.sqlite_pages import LeafPages, NO_ROW
from odocal_ros.errors import BadBag
from odocal_ros.safe_io.limits import Allowance, Damaged, limit_factor, MESSAGE_BYTES

ALLOWED_ACTIONS = {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ}
TABLES_READ = {'messages', 'topics', 'message_definitions'}
ROWS_AS_WRITTEN = 'SELECT rowid, topic_id, timestamp, data FROM messages ORDER BY rowid'
# sorts row numbers, not rows with their data; without LIMIT sqlite ignores that order
ROWS_BY_TIME = ('SELECT m.rowid, topic_id, timestamp, data FROM (SELECT rowid AS row FROM '
                'messages ORDER BY timestamp LIMIT -1) CROSS JOIN messages AS m ON m.rowid = row')


class SqliteFile(BagFile):
    """
    A database of messages.

    Only plain tables are read: views, functions and other content of a schema never run. The size
    of the file limits the steps that sqlite takes for a query.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        super().__init__(path, allowance)
        self._opened_status = path.stat()
        self._leaf_pages: LeafPages | None = None
        self._is_sorted = True
        self._db = sqlite3.connect(f'file:{quote(str(path.resolve()))}?mode=ro&immutable=1',
                                   uri=True, check_same_thread=False)
        try:
            self._restrict_sqlite()
            self._read_channels()
        except BaseException:
            self.close()
            raise

    def _restrict_sqlite(self) -> None:
        """Restrict sqlite to reading rows of tables, each no larger than file and limit."""
        db = self._db
        db.text_factory = lambda raw: raw.decode(errors='replace')
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH,
                    min(max(self._opened_status.st_size, 100_000),
                        int(min(MESSAGE_BYTES * limit_factor(), 2**30))))
        # without it, sqlite refuses a file that is shorter than stated in its header
        db.execute('PRAGMA writable_schema=ON')
        db.execute('PRAGMA trusted_schema=OFF')
        db.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in ALLOWED_ACTIONS
                          else sqlite3.SQLITE_DENY)

    def _query(self, sql: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, or raise Damaged."""
        steps = 10_000    # of sqlite's virtual machine between two checks of their number
        # for any file, plus a number for each byte: reading a row of ten bytes takes about 30
        largest = (20_000_000 + 20 * self._opened_status.st_size) * limit_factor()
        checks_left = int(largest) // steps

        def exceeds_limit() -> bool:
            nonlocal checks_left
            checks_left -= 1
            return checks_left < 0
        self._db.set_progress_handler(exceeds_limit, steps)
        try:
            for row in self._db.execute(sql):  # noqa: UP028 that would close the cursor
                yield row
        except sqlite3.Error as error:
            raise Damaged('invalid pages' if checks_left >= 0 else
                          'its tables contain a cycle') from error
        except (OverflowError, ValueError) as error:
            raise Damaged('invalid pages') from error

    def _read_channels(self) -> None:
        kinds = dict(self._query('SELECT name, type FROM sqlite_master'))     # by name
        views = [name for name in TABLES_READ & kinds.keys() if kinds[name] != 'table']
        if views:
            raise Damaged(f'{", ".join(sorted(views))}: no table')
        definitions = self._definitions()
        self._channels = {
            topic_id: Channel(topic, msgtype, 0, form, definitions.get(msgtype, ('', '')))
            for topic_id, topic, msgtype, form in self._query(
                'SELECT id, name, type, serialization_format FROM topics')
            if isinstance(topic_id, int)
            and all(isinstance(text, str) for text in (topic, msgtype, form))}
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
                if all(isinstance(value, str) for value in (msgtype, form, text))}

    def _use_leaf_pages(self, error: Damaged) -> None:
        """Switch to the leaf pages: inner pages, which SQL needs, are damaged or missing."""
        try:
            self._leaf_pages = LeafPages(self.path)
        except NO_ROW as page_error:
            raise Damaged(f'{error}; {page_error}') from None
        self.damage = 'truncated' if self._leaf_pages.is_truncated else str(error)

    def _scan(self) -> Iterator[tuple[int, int]]:
        rows: Iterator[tuple[Any, ...]] = (
            self._leaf_pages.rows(None) if self._leaf_pages
            else self._query('SELECT topic_id, timestamp, NULL FROM messages'))
        previous_ns = -1
        for topic_id, time_ns, _ in rows:
            if topic_id in self._channels and is_valid_time(time_ns):
                self._is_sorted &= time_ns >= previous_ns
                previous_ns = time_ns
                yield topic_id, time_ns

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Yield the messages of some topics (name -> type) by time; as written if damaged."""
        channels, last_row = self._channels_of(topics), -1
        if not self._leaf_pages:
            try:
                sql = ROWS_AS_WRITTEN if self._is_sorted else ROWS_BY_TIME
                for row, topic_id, time_ns, raw in self._query(sql):
                    if topic_id in channels and is_valid_time(time_ns):
                        # text and numbers are not messages: readers count b'' as unreadable
                        yield channels[topic_id], time_ns, raw if isinstance(raw, bytes) else b''
                    last_row = row
                self._refuse_if_changed()
                return
            except Damaged as error:
                self._refuse_if_changed()
                self._use_leaf_pages(error)
                self._count()
        assert self._leaf_pages
        if not self._is_sorted:      # the rows read so far are not the first ones written
            last_row = -1
        for topic_id, time_ns, raw in self._leaf_pages.rows(channels, last_row):
            if is_valid_time(time_ns):
                yield channels[topic_id], time_ns, raw

    def _refuse_if_changed(self) -> None:
        """Raise BadBag if the file was written since it was opened: SQL may see a mixture."""
        now, opened = self.path.stat(), self._opened_status
        if (now.st_size, now.st_mtime_ns) != (opened.st_size, opened.st_mtime_ns):
            raise BadBag(f'{self.path}: the file changes while it is read; stop the recorder '
                         'first')

    def close(self) -> None:
        self._db.close()
        if self._leaf_pages:
            self._leaf_pages.close()
