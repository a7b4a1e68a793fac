# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Arrays in unnamed files: hours of samples, and work space of that length.

For readers they are normal arrays. ``let_go`` releases their memory if they are large: released
data is read again on access. If the disk is full, arrays are in memory.
"""

from collections.abc import Iterator
import contextlib
from itertools import pairwise
import math
import mmap
import os
import tempfile
from threading import Lock
from typing import Any, BinaryIO
from weakref import WeakSet

import numpy as np
from numpy.typing import DTypeLike, NDArray

ROOM_BYTES = 2**24      # judgement: least bytes of a work array in a file
# judgement: bytes of all arrays in files that stay in memory, since reading pages again takes time
HELD_BYTES = 2**27
LET_GO_AFTER = 512      # judgement: rows between releases of mapped memory
_maps: WeakSet[mmap.mmap] = WeakSet()
_lock = Lock()


def nameless() -> BinaryIO:
    """Return a file that is removed with its last reference."""
    return tempfile.TemporaryFile(prefix='odocal_')


def mapped(file: BinaryIO, size: int, access: int = mmap.ACCESS_WRITE) -> mmap.mmap:
    """Return a file's bytes as memory that ``let_go`` can release; size 0: all bytes."""
    pages = mmap.mmap(file.fileno(), size, access=access)
    with _lock:
        _maps.add(pages)
    return pages


def room(*shape: int, dtype: DTypeLike = float) -> NDArray[Any]:
    """Return a work array of zeros; a large one is in a file if the disk has space."""
    size = np.dtype(dtype).itemsize * math.prod(shape)
    if size >= ROOM_BYTES:
        with contextlib.suppress(OSError), nameless() as file:
            os.posix_fallocate(file.fileno(), 0, size)      # without space, a write would kill
            return np.frombuffer(mapped(file, size), dtype).reshape(shape)
    return np.zeros(shape, dtype)


def let_go() -> None:
    """Release the memory of arrays in files if it is large; they stay usable."""
    with _lock:
        maps = list(_maps)
    if sum(map(len, maps)) > HELD_BYTES:
        for pages in maps:
            pages.madvise(mmap.MADV_DONTNEED)


def blocks(n: int) -> Iterator[slice]:
    """
    Yield slices of n rows of nearly equal length.

    A slice has more than one row if n has: numpy multiplies a single matrix differently from a
    stack, and results must not depend on the chunks. Mapped memory is released periodically.
    """
    at_a_time = 64      # their matrices stay in the cache
    edges = np.linspace(0, n, max(1, -(-n // at_a_time)) + 1).astype(int)
    for first, last in pairwise(edges.tolist()):
        yield slice(first, last)
        if last // LET_GO_AFTER > first // LET_GO_AFTER or last == n:
            let_go()


def stepping(numbers: range) -> Iterator[int]:
    """Yield numbers; mapped memory is released periodically."""
    for k in numbers:
        yield k
        if k % LET_GO_AFTER == 0:
            let_go()
