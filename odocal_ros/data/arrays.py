# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Array types, arrays in unnamed files, and long columns processed in pieces.

Shapes and units are documented at each array. The IMU rows of a long leg are most of the memory of
a computation, and each further column of this length needs as much: work arrays are in files, and
columns are processed in pieces, bitwise equal to processing at once. For readers an array in a
file is a normal one; ``release_mapped_memory`` releases its memory, and released data is read
again on access. If the disk is full, arrays are in memory.
"""

from collections.abc import Callable, Iterator
import contextlib
from functools import reduce
from itertools import pairwise
import math
import mmap
import os
import tempfile
from threading import Lock
from typing import Any, BinaryIO, TypeVar
from weakref import WeakSet

import numpy as np
from numpy.typing import DTypeLike, NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Values = NDArray[np.int64] | NDArray[np.float64]     # raw values of an odometer
FloatOrFloats = TypeVar('FloatOrFloats', float, Floats)
WORK_ARRAY_BYTES = 2**24      # judgement: least bytes of a work array in a file
# judgement: bytes of all arrays in files that stay in memory, since reading pages again takes time
HELD_BYTES = 2**27
RELEASE_ROWS = 512      # judgement: rows between releases of mapped memory
_maps: WeakSet[mmap.mmap] = WeakSet()
_lock = Lock()
Array = NDArray[Any]
PIECE_ROWS = 2**16    # judgement: rows


def unnamed_file() -> BinaryIO:
    """Return a file that is removed with its last reference."""
    return tempfile.TemporaryFile(prefix='odocal_')


def map_file(file: BinaryIO, size: int, access: int = mmap.ACCESS_WRITE) -> mmap.mmap:
    """Return a file's bytes as memory that can be released; size 0: all bytes."""
    pages = mmap.mmap(file.fileno(), size, access=access)
    with _lock:
        _maps.add(pages)
    return pages


def work_array(*shape: int, dtype: DTypeLike = float) -> NDArray[Any]:
    """Return a work array of zeros; a large one is in a file if the disk has space."""
    size = np.dtype(dtype).itemsize * math.prod(shape)
    if size >= WORK_ARRAY_BYTES:
        with contextlib.suppress(OSError), unnamed_file() as file:
            os.posix_fallocate(file.fileno(), 0, size)      # without space, a write would kill
            return np.frombuffer(map_file(file, size), dtype).reshape(shape)
    return np.zeros(shape, dtype)


def release_mapped_memory() -> None:
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
        if last // RELEASE_ROWS > first // RELEASE_ROWS or last == n:
            release_mapped_memory()


def iterate_releasing(numbers: range) -> Iterator[int]:
    """Yield numbers; mapped memory is released periodically."""
    for k in numbers:
        yield k
        if k % RELEASE_ROWS == 0:
            release_mapped_memory()


def chunks(n: int) -> Iterator[slice]:
    """Yield slices of n rows; memory of arrays in files is released after each."""
    for first in range(0, n, PIECE_ROWS):
        yield slice(first, min(first + PIECE_ROWS, n))
        release_mapped_memory()


def by_row(function: Callable[..., Array], *columns: Array) -> Array:
    """Return the result of a function for each row of arrays, in pieces: (n, ...) to (n,)."""
    return by_step(function, *columns, steps=0)


def by_step(function: Callable[..., Array], *columns: Array, steps: int = 1) -> Array:
    """
    Return the results of a function of adjacent rows, in pieces: (m, ...) to (m - steps,).

    steps : rows that the function needs after a row, 1: each result is of a row and the next.
    """
    n = len(columns[0]) - steps
    if n <= PIECE_ROWS:
        return function(*columns)
    for rows in chunks(n):
        part = function(*(x[rows.start:rows.stop + steps] for x in columns))
        if not rows.start:
            out = work_array(n, *part.shape[1:], dtype=part.dtype)
        out[rows] = part
    return out


def thinned(x: Array, rows: int) -> Array:
    """Return at least ``rows`` evenly spaced rows, or all if there are fewer: (n, ...)."""
    step = max(1, len(x) // rows)
    return np.concatenate([x[some][-some.start % step::step].copy() for some in chunks(len(x))]
                          or [x])


def running_sum(steps: Array) -> Array:
    """Return the sums of the steps before each row, 0 first: (n, ...) to (n + 1, ...)."""
    total = np.cumsum(steps, axis=0)
    return np.concatenate([np.zeros((1, *total.shape[1:]), total.dtype), total])


def reduce_columns(ufunc: np.ufunc, x: Array) -> Array:
    """Return ``ufunc.reduce(x, axis=1)``, (n, k) to (n,); numpy's own takes ten times as long."""
    return reduce(ufunc, x.T)


def lengths(x: Floats) -> Floats:
    """Return ``np.linalg.norm(x, axis=1)``, (n, k) to (n,); faster, as ``reduce_columns``."""
    return np.sqrt(reduce_columns(np.add, x * x))


def runs(flags: Bools) -> Ints:
    """Return begin and end of the runs of True: (k, 2), ends exclusive."""
    return np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)


def median(x: Floats) -> float:
    """
    Return the median of x, (n,), like numpy but four times as fast for many rows.

    Only the values near the median of a subset are sorted.
    """
    if len(x) < PIECE_ROWS:
        return float(np.median(x))
    few = np.sort(x[::64])
    low, high = few[[int(0.45 * len(few)), int(0.55 * len(few))]]
    below, above = np.count_nonzero(x < low), np.count_nonzero(x > high)
    middle = x[(x >= low) & (x <= high)]
    at = len(x) // 2 - below        # of the upper of the two in the middle
    if not 0 < at < len(middle) or below + len(middle) + above < len(x):     # NaN is neither
        return float(np.median(x))
    middle.partition(at)
    return float(middle[at] if len(x) % 2 else (middle[:at].max() + middle[at]) / 2)


def columns(x: Floats) -> Iterator[Floats]:
    """Yield the columns of x, (n, k), one at a time in the same memory: (n,)."""
    column = work_array(len(x))
    for k in range(x.shape[1]):
        for rows in chunks(len(x)):
            column[rows] = x[rows, k]
        yield column


def medians(x: Floats) -> Floats:
    """Return the median of each column: (n, k) to (k,)."""
    return np.array([median(column) for column in columns(x)])


def bin_means(t: Floats, edges: Floats, *vectors: Floats) -> tuple[Ints, list[Floats]]:
    """
    Return the number of rows in each bin, (m,), and the mean of each vector there, (m, k).

    t : (n,) times of the rows, rising.   edges : (m + 1,) of the bins, in the same unit; a bin
    includes its upper edge.   vectors : (n, k) values of the rows; 0 in an empty bin.
    """
    first = np.searchsorted(t, edges, side='right')
    count = np.diff(first)
    means = [np.empty((len(count), vector.shape[1])) for vector in vectors]
    bins_at_a_time = 64    # limits the memory
    for bins in (slice(k, k + bins_at_a_time) for k in range(0, len(count), bins_at_a_time)):
        rows = slice(first[bins.start], first[bins.start + len(count[bins])])
        cell = np.repeat(np.arange(len(count[bins])), count[bins])
        for mean, vector in zip(means, vectors, strict=True):
            for k, column in enumerate(vector[rows].T):
                mean[bins, k] = np.bincount(cell, column, len(count[bins]))
        release_mapped_memory()
    divisor = np.maximum(count, 1)[:, None]
    return count, [mean / divisor for mean in means]


def enclosing_slices(times: Array, t: Array) -> Iterator[tuple[slice, slice]]:
    """
    Yield pairs of slices: of rising times, and of the rows of t between which they are.

    All of both are included; a piece of t shares its last row with the next one.
    """
    begin = 0
    for rows in chunks(len(t) - 1):
        rows = slice(rows.start, rows.stop + 1)
        is_last = rows.stop == len(t)
        end = len(times) if is_last else max(np.searchsorted(times, t[rows.stop - 1]), begin)
        yield slice(begin, end), rows
        begin = end
