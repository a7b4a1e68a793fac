# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Array types, arrays in unnamed files, and functions for long arrays, which work in chunks of rows.

The IMU rows of a long leg need most of the memory of a computation, and each further column of
this length as much again. Large work arrays are therefore in memory-mapped files, and long arrays
are processed in chunks; the results are bitwise equal to processing all rows at once.
``release_mapped_memory`` frees the memory of mapped arrays, whose data is read from the file again
on access. If the disk is full, arrays are in memory.
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
# judgement: bytes of mapped arrays that stay in memory, since reading pages again takes time
MAX_RESIDENT_BYTES = 2**27
RELEASE_ROWS = 512      # judgement: rows between releases of mapped memory
CHUNK_ROWS = 2**16      # judgement: rows that are processed at a time
Array = NDArray[Any]
_maps: WeakSet[mmap.mmap] = WeakSet()      # of all threads
_lock = Lock()                             # of ``_maps``


def unnamed_file() -> BinaryIO:
    """Return a file that is removed with its last reference."""
    return tempfile.TemporaryFile(prefix='odocal_')


def map_file(file: BinaryIO, size: int, access: int = mmap.ACCESS_WRITE) -> mmap.mmap:
    """Map a file into memory that ``release_mapped_memory`` frees; size : bytes, 0: all."""
    pages = mmap.mmap(file.fileno(), size, access=access)
    with _lock:
        _maps.add(pages)
    return pages


def work_array(*shape: int, dtype: DTypeLike = float) -> NDArray[Any]:
    """Return a work array of zeros; a large one is in a file if the disk has space."""
    size = np.dtype(dtype).itemsize * math.prod(shape)
    if size >= WORK_ARRAY_BYTES:
        with contextlib.suppress(OSError), unnamed_file() as file:
            os.posix_fallocate(file.fileno(), 0, size)    # else writing to a full disk kills
            return np.frombuffer(map_file(file, size), dtype).reshape(shape)
    return np.zeros(shape, dtype)


def release_mapped_memory() -> None:
    """Free the memory of mapped arrays if it is large; the arrays stay usable."""
    with _lock:
        maps = list(_maps)
    if sum(map(len, maps)) > MAX_RESIDENT_BYTES:
        for pages in maps:
            pages.madvise(mmap.MADV_DONTNEED)


def blocks(n: int) -> Iterator[slice]:
    """
    Yield slices of n rows, of at most 48 rows and nearly equal length, for stacks of matrices.

    No slice has a single row if n > 1: numpy multiplies a single matrix differently from a stack,
    and results must not depend on the slices. Mapped memory is released periodically.
    """
    max_rows = 48      # their matrices stay in the cache
    edges = np.linspace(0, n, max(1, math.ceil(n / max_rows)) + 1).astype(int)
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
    """Yield slices of n rows, each of CHUNK_ROWS; mapped memory is released after each."""
    for first in range(0, n, CHUNK_ROWS):
        yield slice(first, min(first + CHUNK_ROWS, n))
        release_mapped_memory()


def map_rows(function: Callable[..., Array], *arrays: Array) -> Array:
    """Return ``function(*arrays)``, computed in chunks: a result, (n, ...), for each of n rows."""
    return map_windows(function, *arrays, following=0)


def map_windows(function: Callable[..., Array], *arrays: Array, following: int = 1) -> Array:
    """
    Return ``function(*arrays)``, in chunks; each result depends on a row and the next ones.

    following : number of the next rows; (n, ...) arrays give (n - following, ...) results.
    """
    n = len(arrays[0]) - following
    if n <= CHUNK_ROWS:
        return function(*arrays)
    for rows in chunks(n):
        part = function(*(x[rows.start:rows.stop + following] for x in arrays))
        if not rows.start:
            result = work_array(n, *part.shape[1:], dtype=part.dtype)
        result[rows] = part
    return result


def thinned(x: Array, min_rows: int) -> Array:
    """Return evenly spaced rows of x, at least ``min_rows``, or all if there are fewer."""
    step = max(1, len(x) // min_rows)      # rows whose number is a multiple of it
    parts = [x[rows][-rows.start % step::step].copy() for rows in chunks(len(x))]
    return np.concatenate(parts or [x])


def running_sum(steps: Array) -> Array:
    """Return the sums of the steps before each row, 0 first: (n, ...) to (n + 1, ...)."""
    total = np.cumsum(steps, axis=0)
    return np.concatenate([np.zeros((1, *total.shape[1:]), total.dtype), total])


def reduce_columns(ufunc: np.ufunc, x: Array) -> Array:
    """Return ``ufunc.reduce(x, axis=1)``, (n, k) to (n,), which takes numpy ten times as long."""
    return reduce(ufunc, x.T)


def lengths(x: Floats) -> Floats:
    """Return ``np.linalg.norm(x, axis=1)``, (n, k) to (n,); faster, as ``reduce_columns``."""
    return np.sqrt(reduce_columns(np.add, x * x))


def runs(flags: Bools) -> Ints:
    """Return begin and end of the runs of True: (k, 2), ends exclusive."""
    # changes of the flags are begin and end by turns
    return np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)


def median(x: Floats) -> float:
    """Return the median of x, (n,), as np.median; of many rows only the middle ones are sorted."""
    if len(x) < CHUNK_ROWS:
        return float(np.median(x))
    sample = np.sort(x[::64])
    low, high = sample[[int(0.45 * len(sample)), int(0.55 * len(sample))]]
    below, above = np.count_nonzero(x < low), np.count_nonzero(x > high)
    middle = x[(x >= low) & (x <= high)]
    has_nan = below + len(middle) + above < len(x)
    upper = len(x) // 2 - below      # rank in ``middle``: of the median, or the value above it
    if has_nan or not 0 < upper < len(middle):
        return float(np.median(x))
    middle.partition(upper)
    return float(middle[upper] if len(x) % 2 else (middle[:upper].max() + middle[upper]) / 2)


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
    for k in range(0, len(count), bins_at_a_time):
        bins = slice(k, min(k + bins_at_a_time, len(count)))
        rows = slice(first[bins.start], first[bins.stop])
        bin_of_row = np.repeat(np.arange(bins.stop - k), count[bins])
        for mean, vector in zip(means, vectors, strict=True):
            for axis, values in enumerate(vector[rows].T):
                mean[bins, axis] = np.bincount(bin_of_row, values, bins.stop - k)
        release_mapped_memory()
    divisor = np.maximum(count, 1)[:, None]
    return count, [mean / divisor for mean in means]


def enclosing_slices(times: Array, t: Array) -> Iterator[tuple[slice, slice]]:
    """
    Yield pairs of slices: of rising times, and of the rows of t that enclose these times.

    The slices of the times cover all of them. A slice of t shares its last row with the next one.
    """
    begin = 0
    for rows in chunks(len(t) - 1):
        rows = slice(rows.start, rows.stop + 1)
        is_last = rows.stop == len(t)
        end = len(times) if is_last else max(np.searchsorted(times, t[rows.stop - 1]), begin)
        yield slice(begin, end), rows
        begin = end
