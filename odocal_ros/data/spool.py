# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rows of a topic: up to MEMORY_BYTES in memory, more of them in an unnamed file.

Two hours of an IMU at 1 kHz are 0.8 GB. The file is mapped: for readers its rows are normal
arrays, and ``release_mapped_memory`` releases their memory. If the disk is full, rows stay in
memory.
"""

from collections.abc import Callable
import math
import mmap
import os
from typing import Any, BinaryIO

import numpy as np

from odocal_ros.data.arrays import Bools, map_file, unnamed_file
from odocal_ros.data.samples import columns_of, join, of_columns, Samples, take

MEMORY_BYTES = 2**24    # judgement: bytes of a topic's rows in memory before a file is used
TAIL_BYTES = 2**23      # judgement: bytes in memory before more is written to the file
MERGED_BYTES = 2**20    # judgement: bytes of small blocks that are merged to one
LARGE_BYTES = 2**17     # judgement: bytes of a block that is not small
MOVED_BYTES = 2**20     # judgement: bytes written at a time


class Rows:
    """The rows of one topic, in order of arrival."""

    def __init__(self, make_empty: Callable[[], Samples]) -> None:
        self._make_empty, self.newest_ns = make_empty, 0     # stamp of the last row fed
        self._file: _Columns | None = None    # the first rows
        self._stop = 0                        # number of this object's rows in the file
        self._blocks: list[Samples] = []      # after those of the file
        self._small: list[Samples] = []       # small blocks, after the blocks
        self._size = self._small_size = 0     # bytes of both, and of the small blocks
        self._writes = True                   # False: the file is not written

    def feed(self, block: Samples) -> None:
        """Append a block."""
        size, self.newest_ns = _size(block), int(block.stamp_ns[-1])
        self._small.append(block)
        self._small_size += size
        self._size += size
        if self._small_size >= MERGED_BYTES or size >= LARGE_BYTES:
            self._merge()
            if self._size > (MEMORY_BYTES if self._file is None else TAIL_BYTES):
                self._to_file()

    def all(self) -> Samples:
        """Return all rows as one block; rows in a file as a view of it."""
        self._merge()
        if self._file is not None:
            self._to_file()
        parts = [*([self._file.rows(self._stop)] if self._file else []), *self._blocks]
        if not parts:
            return self._make_empty()
        if len(parts) > 1:
            self._hold([join(parts)])
            return self._blocks[0]
        return parts[0]

    def snapshot(self) -> 'Rows':
        """Return a copy of the rows so far; ``feed`` and ``forget`` here do not change it."""
        if self._file is not None:
            self._merge()
            self._to_file()
        copy = Rows(self._make_empty)
        copy._writes = False              # only this object writes to the file
        copy._hold([*self._blocks, *self._small])
        copy._file, copy._stop, copy.newest_ns = self._file, self._stop, self.newest_ns
        return copy

    def forget(self, before: Callable[[Samples], Bools]) -> None:
        """Drop leading blocks for which ``before``, (n,) bool of a block, is true in all rows."""
        if self._file is not None and before(self._file.row(self._stop // 2)).all():
            # most of it can be dropped: the rest is the pre-roll of the next leg
            rows = self.all()
            late = np.flatnonzero(~before(rows))
            kept = slice(late[0], None) if len(late) else slice(0, 0)
            self._hold([take(rows, np.arange(len(rows.stamp_ns))[kept])])
        if self._file is None:
            blocks, keep = [*self._blocks, *self._small], 0
            while keep < len(blocks) and before(blocks[keep]).all():
                keep += 1
            large = max(0, len(self._blocks) - keep)
            self._size -= sum(map(_size, blocks[:keep]))
            self._small_size -= sum(map(_size, blocks[len(self._blocks):keep]))
            self._blocks = self._blocks[len(self._blocks) - large:]
            self._small = blocks[keep + large:]

    def _hold(self, blocks: list[Samples]) -> None:
        self._blocks, self._small, self._file, self._stop = blocks, [], None, 0
        self._size, self._small_size = sum(map(_size, blocks)), 0

    def _merge(self) -> None:
        if self._small:
            self._blocks.append(join(self._small))
            self._small, self._small_size = [], 0

    def _to_file(self) -> None:
        """Move the blocks to the file, as far as the disk has space."""
        try:
            while self._blocks and self._writes:
                if self._file is None:
                    self._file = _Columns(self._blocks[0])
                self._stop = self._file.write(self._blocks[0], self._stop)
                self._size -= _size(self._blocks.pop(0))
        except OSError:
            self._writes = False          # the disk is full
            self._file = self._file if self._stop else None


class _Columns:
    """Samples of one kind in unnamed files, one for each column."""

    def __init__(self, like: Samples) -> None:
        self._kind = type(like)
        self._files: list[tuple[BinaryIO, np.dtype[Any], tuple[int, ...]]] = [
            (unnamed_file(), column.dtype, column.shape[1:]) for column in columns_of(like)]

    def write(self, block: Samples, at: int) -> int:
        """Write a block from row ``at`` on; return the row after it."""
        for (file, dtype, shape), column in zip(self._files, columns_of(block), strict=True):
            data = np.ascontiguousarray(column, dtype).reshape(-1).view(np.uint8).data
            offset, done = at * dtype.itemsize * math.prod(shape), 0
            while done < len(data):
                done += os.pwrite(file.fileno(), data[done:done + MOVED_BYTES], offset + done)
        return at + len(block.stamp_ns)

    def rows(self, stop: int) -> Samples:
        """Return the rows before row ``stop``, mapped."""
        return of_columns(self._kind, *(
            np.frombuffer(map_file(file, 0, mmap.ACCESS_READ), dtype,
                          stop * math.prod(shape)).reshape(stop, *shape)
            for file, dtype, shape in self._files))

    def row(self, at: int) -> Samples:
        """Return one row, read."""
        return of_columns(self._kind, *(
            np.frombuffer(os.pread(file.fileno(), size, at * size), dtype).reshape(1, *shape)
            for file, dtype, shape in self._files
            for size in [dtype.itemsize * math.prod(shape)]))


def _size(block: Samples) -> int:
    return sum(column.nbytes for column in columns_of(block))
