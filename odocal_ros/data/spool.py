# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Storage of the rows of a topic: up to MEMORY_BYTES in memory, more of them in unnamed files.

Two hours of an IMU at 1 kHz are 0.8 GB. The files are memory-mapped: for readers their rows are
normal arrays, and ``release_mapped_memory`` frees their memory. If the disk is full, rows stay in
memory.
"""

from collections.abc import Callable
import math
import mmap
import os
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from odocal_ros.data.arrays import Bools, map_file, unnamed_file
from odocal_ros.data.samples import columns_of, from_columns, join, Samples, take

MEMORY_BYTES = 2**24    # judgement: bytes of a topic's rows in memory before a file is used
TAIL_BYTES = 2**23      # judgement: bytes in memory before more is written to the file
MERGED_BYTES = 2**20    # judgement: bytes of small blocks that are merged to one
LARGE_BYTES = 2**17     # judgement: bytes of a block after which small blocks are merged
WRITE_BYTES = 2**20     # judgement: bytes written at a time


class Rows:
    """The rows of one topic, in order of arrival."""

    def __init__(self, make_empty: Callable[[], Samples]) -> None:
        self._make_empty = make_empty
        self.newest_ns = 0                    # stamp of the last row
        # the rows are those of the file, then those of the blocks, then those of the small blocks
        self._file: _Columns | None = None
        self._file_rows = 0                   # rows in the file; a copy may own fewer of them
        self._blocks: list[Samples] = []
        self._small: list[Samples] = []
        self._size = self._small_size = 0     # bytes of all blocks, and of the small ones
        self._may_write = True                # False: of a copy, or the disk is full

    def feed(self, block: Samples) -> None:
        """Append a block."""
        size, self.newest_ns = _size(block), int(block.stamp_ns[-1])
        self._small.append(block)
        self._small_size += size
        self._size += size
        if self._small_size >= MERGED_BYTES or size >= LARGE_BYTES:
            self._merge()
            if self._size > (MEMORY_BYTES if self._file is None else TAIL_BYTES):
                self._move_to_file()

    def all(self) -> Samples:
        """Return all rows as one block; rows in a file as a view of it."""
        self._merge()
        if self._file is not None:
            self._move_to_file()
        parts = [self._file.rows(self._file_rows), *self._blocks] if self._file else self._blocks
        if len(parts) > 1:
            self._replace_all([join(parts)])
            return self._blocks[0]
        return parts[0] if parts else self._make_empty()

    def snapshot(self) -> 'Rows':
        """Return a copy of the rows so far; ``feed`` and ``forget`` here do not change it."""
        if self._file is not None:
            self._merge()
            self._move_to_file()
        copy = Rows(self._make_empty)
        copy._may_write = False              # only this object writes to the file
        copy._replace_all([*self._blocks, *self._small])
        copy._file, copy._file_rows, copy.newest_ns = self._file, self._file_rows, self.newest_ns
        return copy

    def forget(self, is_old: Callable[[Samples], Bools]) -> None:
        """Drop leading blocks in which ``is_old``, (n,) bool of a block, is true for all rows."""
        middle = self._file_rows // 2
        if self._file is not None and is_old(
                take(self._file.rows(self._file_rows), slice(middle, middle + 1))).all():
            # only the pre-roll of the next leg, a small part, is still needed: copied to memory
            rows = self.all()
            count, kept = len(rows.stamp_ns), np.flatnonzero(~is_old(rows))
            self._replace_all([take(rows, np.arange(kept[0] if len(kept) else count, count))])
        if self._file is None:
            for blocks in (self._blocks, self._small):
                while blocks and is_old(blocks[0]).all():
                    self._size -= _size(blocks.pop(0))
                if blocks:
                    break
            self._small_size = sum(map(_size, self._small))

    def _replace_all(self, blocks: list[Samples]) -> None:
        """Store the rows of some blocks instead of the present rows."""
        self._blocks, self._small, self._file, self._file_rows = blocks, [], None, 0
        self._size, self._small_size = sum(map(_size, blocks)), 0

    def _merge(self) -> None:
        if self._small:
            self._blocks.append(join(self._small))
            self._small, self._small_size = [], 0

    def _move_to_file(self) -> None:
        """Move the blocks to the file, as far as the disk has space."""
        try:
            while self._blocks and self._may_write:
                if self._file is None:
                    self._file = _Columns(self._blocks[0])
                self._file.write(self._blocks[0], self._file_rows)
                self._file_rows += len(self._blocks[0].stamp_ns)
                self._size -= _size(self._blocks.pop(0))
        except OSError:
            self._may_write = False          # the disk is full
            self._file = self._file if self._file_rows else None


class _Column(NamedTuple):
    """A column of samples in an unnamed file."""

    file: BinaryIO
    dtype: np.dtype[Any]        # of the values
    shape: tuple[int, ...]      # of a row


class _Columns:
    """Samples of one type in unnamed files, one for each column, of the columns of ``example``."""

    def __init__(self, example: Samples) -> None:
        self._type = type(example)
        self._columns = [_Column(unnamed_file(), values.dtype, values.shape[1:])
                         for values in columns_of(example)]

    def write(self, block: Samples, first_row: int) -> None:
        """Write a block from a row of the files on; raises OSError if the disk is full."""
        for (file, dtype, shape), values in zip(self._columns, columns_of(block), strict=True):
            data = np.ascontiguousarray(values, dtype).reshape(-1).view(np.uint8).data
            offset, done = first_row * dtype.itemsize * math.prod(shape), 0
            while done < len(data):
                done += os.pwrite(file.fileno(), data[done:done + WRITE_BYTES], offset + done)

    def rows(self, stop: int) -> Samples:
        """Return the rows before row ``stop``, as views of the mapped files."""
        return from_columns(self._type, *(
            np.frombuffer(map_file(file, 0, mmap.ACCESS_READ), dtype,
                          stop * math.prod(shape)).reshape(stop, *shape)
            for file, dtype, shape in self._columns))


def _size(block: Samples) -> int:
    """Return the size of a block in bytes."""
    return sum(column.nbytes for column in columns_of(block))
