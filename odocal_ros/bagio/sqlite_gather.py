# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rows of the table ``messages`` of a sqlite3 bag as columns, from its pages, many at a time.

A table is a tree of pages (sqlite.org/fileformat2.html#b_tree_pages): inner ones name others,
leaves hold rows as cells, each a record of four values (#record_format). What is not exactly as
rosbag2 and sqlite write it gives None, and is left to SQL.
"""

from collections.abc import Iterator, Mapping
import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.bagio.channels import Batch, Channel
from odocal_ros.bagio.file_bytes import FileBytes
from odocal_ros.bagio.sqlite_leaves import INTEGERS, LEAF
from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.messages.raws import Raws

SCHEMA = ('createtablemessages(idintegerprimarykey,topic_idintegernotnull,'
          'timestampintegernotnull,datablobnotnull)')
INNER = 0x05             # format: kind of page of pages, sqlite.org/fileformat2
BLOCK = 2**21            # judgement: bytes of pages looked at in one go
Table = NDArray[np.uint8]


class Odd(Exception):
    """Something that is not as it should be, or not as it is mostly."""


class Rows(NamedTuple):
    """Rows by their numbers: number, topic, bag time, where the message lies."""

    id: Ints
    key: Ints
    time_ns: Ints
    page: NDArray[np.int32]      # from 0
    offset: NDArray[np.int32]    # in the page; -1: a part of it lies on other pages
    size: NDArray[np.int32]

    def take(self, which: Ints | Bools) -> 'Rows':
        """Return some rows."""
        return Rows._make(column[which] for column in self)


class Pages:
    """The pages of a database."""

    def __init__(self, file: FileBytes) -> None:
        self._file = file
        head = file[:100]
        size = int.from_bytes(head[16:18], 'big')
        self.size = 65536 if size == 1 else size
        self.usable = self.size - head[20] if len(head) == 100 else 0
        self.count = int.from_bytes(head[28:32], 'big')
        if self.usable < 480 or self.size * self.count != len(file):
            raise Odd('size')

    def some(self, numbers: Ints) -> Table:
        """Return (n, size) pages; numbers rise."""
        if not len(numbers) or numbers[0] < 0 or numbers[-1] >= self.count or (
                np.diff(numbers) <= 0).any():
            raise Odd('pages')
        far = 8    # pages not asked for that are read rather than passed over
        runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > far) + 1)
        parts = []
        for run in runs:
            first, last = int(run[0]), int(run[-1])
            data = np.frombuffer(self._file[first * self.size:(last + 1) * self.size], np.uint8)
            if data.size != (last + 1 - first) * self.size:
                raise Odd('short')
            table = data.reshape(-1, self.size)
            parts.append(table if len(run) == len(table) else table[run - first])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def blocks(self, numbers: Ints) -> Iterator[tuple[Ints, Table]]:
        """Yield pages, some at a time, in the order given."""
        some = max(BLOCK // self.size, 1)
        for at in range(0, len(numbers), some):
            mine = numbers[at:at + some]
            order = np.argsort(mine, kind='stable')
            table = self.some(mine[order])
            rising = bool((np.diff(mine) > 0).all())
            yield mine, table if rising else table[np.argsort(order)]


def rows_of(file: FileBytes, root: int) -> Rows | None:
    """Return the rows of a table by the number of its first page; None where anything is odd."""
    if not (isinstance(root, int) and root > 0):
        return None
    try:
        pages = Pages(file)
        found = [_rows(numbers, table, pages.usable)
                 for numbers, table in pages.blocks(_leaves(pages, root - 1))]
    except Odd:
        return None
    rows = Rows._make(map(np.concatenate, zip(*found, strict=True)))
    return rows if (np.diff(rows.id) > 0).all() else None


def _leaves(pages: Pages, root: int) -> Ints:
    """Return the leaves of a tree in their order."""
    level = np.array([root], np.int64)
    deepest = 20    # levels of a tree, as sqlite has it
    for _ in range(deepest):
        kind = {int(k) for _, table in pages.blocks(level[:1]) for k in table[:, 0]}
        if kind == {LEAF}:
            return level
        if kind != {INNER}:
            break
        level = np.concatenate([below for _, table in pages.blocks(level)
                                for below in map(_below, table)]) - 1
        if len(level) > pages.count:
            break
    raise Odd('tree')


def _below(page: Table) -> Ints:
    """Return the pages that an inner one names, from 1."""
    count = int.from_bytes(page[3:5].tobytes(), 'big')
    at = page[12:12 + 2 * count].view('>u2').astype(np.int64)
    if page[0] != INNER or not count or len(at) < count or (at > len(page) - 4).any():
        raise Odd('inner page')
    named = page[at[:, None] + np.arange(4)].view('>u4')[:, 0]
    return np.append(named, page[8:12].view('>u4')).astype(np.int64)


def _rows(numbers: Ints, table: Table, usable: int) -> Rows:
    """Return the rows on leaves."""
    size = table.shape[1]
    count = table[:, 3:5].copy().view('>u2')[:, 0].astype(np.int64)
    if (table[:, 0] != LEAF).any() or not count.all() or count.max() > (usable - 8) // 6:
        raise Odd('leaf')
    most = int(count.max())
    cells = table[:, 8:8 + 2 * most].copy().view('>u2').astype(np.int64)
    there = np.arange(most) < count[:, None]
    page = np.nonzero(there)[0]
    cell = cells[there]
    if (cell < 8 + 2 * count[page]).any() or (cell >= usable).any():
        raise Odd('cell')
    data = np.append(table.reshape(-1), np.zeros(64, np.uint8))     # to read beyond a last cell
    base = page * size
    length, at = _varint(data, base + cell)
    ids, body = _varint(data, at)
    head, at = _varint(data, body)
    columns, kinds = [], []
    for _ in range(4):
        kind, at = _varint(data, at)
        kinds.append(kind)
    blob = (kinds[3] - 12) // 2
    if kinds[0].any() or (blob < 0).any() or (kinds[3] % 2).any() or (at - body != head).any():
        raise Odd('record')
    for kind in kinds[1:3]:
        value, at = _integer(data, at, kind)
        columns.append(value)
    offset = at - base
    whole = length <= usable - 35
    if (length != at - body + blob).any() or (offset + np.where(whole, blob, 4) > usable).any():
        raise Odd('length')
    places = numbers[page], np.where(whole, offset, -1), np.where(whole, blob, 0)
    return Rows._make([ids, *columns, *(place.astype(np.int32) for place in places)])


def _varint(data: Table, at: Ints) -> tuple[Ints, Ints]:
    """Return numbers of up to five bytes and where each ends (#varint)."""
    byte = data[at]
    value, at = (byte & 0x7F).astype(np.int64), at + 1
    more = np.flatnonzero(byte & 0x80)
    for _ in range(4):
        if not len(more):
            return value, at
        byte = data[at[more]]
        value[more] = value[more] << 7 | byte & 0x7F
        at[more] += 1
        more = more[byte & 0x80 > 0]
    if len(more):
        raise Odd('varint')
    return value, at


def _integer(data: Table, at: Ints, kind: Ints) -> tuple[Ints, Ints]:
    """Return integers of some serial types and where each ends."""
    value, end = np.empty(len(at), np.int64), at.copy()
    kinds = [int(kind[0])] if (kind == kind[0]).all() else np.unique(kind).tolist()
    for each in kinds:
        if each not in INTEGERS:
            raise Odd('serial type')
        mine, width = np.flatnonzero(kind == each), INTEGERS[each]
        raw = data[at[mine, None] + np.arange(width)]
        sign = raw[:, 0] >> 7 if width else np.zeros(len(mine), np.uint8)
        wide = np.empty((len(mine), 8), np.uint8)
        wide[:, :8 - width] = (sign * 255)[:, None]
        wide[:, 8 - width:] = raw
        value[mine] = wide.view('>i8')[:, 0] if width else each - 8
        end[mine] += width
    return value, end


def plain(sql: str) -> bool:
    """Return True if a table has the layout of rosbag2."""
    return isinstance(sql, str) and re.sub(r'\s|;', '', sql).lower() == SCHEMA


def batches(file: FileBytes, rows: Rows, wanted: Mapping[int, Channel]) -> Iterator[Batch]:
    """Yield the messages of rows in the order given, many at a time."""
    pages = Pages(file)
    total = np.cumsum(rows.size.astype(np.int64) + 1)
    cuts = np.searchsorted(total, np.arange(BLOCK, int(total[-1]) if len(total) else 0, BLOCK))
    for mine in np.split(np.arange(len(rows.key)), np.unique(cuts)):
        if not len(mine):
            continue
        some = rows.take(mine)
        numbers, where = np.unique(some.page, return_inverse=True)
        data = pages.some(numbers.astype(np.int64)).tobytes()
        raws = Raws(data, where * pages.size + some.offset, some.size.astype(np.int64))
        batch: Batch = {}
        for topic in dict.fromkeys(channel.topic for channel in wanted.values()):
            keys = [key for key, channel in wanted.items() if channel.topic == topic]
            picked = np.flatnonzero(np.isin(some.key, keys))
            if len(picked):
                batch[topic] = some.time_ns[picked], raws.take(picked)
        yield batch
