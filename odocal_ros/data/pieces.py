# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Long columns processed in pieces, bitwise equal to processing at once.

The IMU rows of a long leg are most of the memory of a computation, and each further column of this
length needs as much.
"""

from collections.abc import Callable, Iterator
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.data.mapped import let_go, room

Array = NDArray[Any]
PIECE_ROWS = 2**16    # judgement: rows


def chunks(n: int) -> Iterator[slice]:
    """Yield slices of n rows; memory of arrays in files is released after each."""
    for first in range(0, n, PIECE_ROWS):
        yield slice(first, min(first + PIECE_ROWS, n))
        let_go()


def by_row(function: Callable[..., Array], *columns: Array) -> Array:
    """Return the result of a function for each row of arrays, (n, ...) to (n,)."""
    return by_step(function, *columns, steps=0)


def by_step(function: Callable[..., Array], *columns: Array, steps: int = 1) -> Array:
    """Return the results of a function of adjacent rows, (m, ...) to (m - steps,)."""
    n = len(columns[0]) - steps
    if n <= PIECE_ROWS:
        return function(*columns)
    for rows in chunks(n):
        part = function(*(x[rows.start:rows.stop + steps] for x in columns))
        if not rows.start:
            found = room(n, *part.shape[1:], dtype=part.dtype)
        found[rows] = part
    return found


def thinned(x: Array, rows: int) -> Array:
    """Return at least ``rows`` evenly spaced rows, or all if there are fewer: (n, ...)."""
    step = max(1, len(x) // rows)
    return np.concatenate([x[some][-some.start % step::step].copy() for some in chunks(len(x))]
                          or [x])


def across(ufunc: np.ufunc, x: Array) -> Array:
    """Return ``ufunc.reduce(x, axis=1)``, (n, k) to (n,); numpy's own takes ten times as long."""
    return reduce(ufunc, x.T)


def lengths(x: Floats) -> Floats:
    """Return ``np.linalg.norm(x, axis=1)``, (n, k) to (n,); faster, as ``across``."""
    return np.sqrt(across(np.add, x * x))


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
    amid = x[(x >= low) & (x <= high)]
    at = len(x) // 2 - below        # of the upper of the two in the middle
    if not 0 < at < len(amid) or below + len(amid) + above < len(x):     # NaN is neither
        return float(np.median(x))
    amid.partition(at)
    return float(amid[at] if len(x) % 2 else (amid[:at].max() + amid[at]) / 2)


def columns(x: Floats) -> Iterator[Floats]:
    """Yield the columns of x, (n, k), one at a time in the same memory: (n,)."""
    column = room(len(x))
    for k in range(x.shape[1]):
        for rows in chunks(len(x)):
            column[rows] = x[rows, k]
        yield column


def medians(x: Floats) -> Floats:
    """Return the median of each column: (n, k) to (k,)."""
    return np.array([median(column) for column in columns(x)])


def bin_means(t: Floats, edges: Floats, *vectors: Floats) -> tuple[Ints, list[Floats]]:
    """
    Return the number of rows in each bin, and the mean of each vector there.

    t : (n,) times of the rows, rising.   edges : (m + 1,) of the bins, in the same unit; a bin
    includes its upper edge.   vectors : (n, k) values of the rows.

    Returns (m,) counts, (m, k) means; 0 in an empty bin.
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
        let_go()
    divisor = np.maximum(count, 1)[:, None]
    return count, [mean / divisor for mean in means]


def pieces(times: Array, t: Array) -> Iterator[tuple[slice, slice]]:
    """Yield slices of rising times and of the rows of t that enclose them; all of each."""
    done = 0
    for rows in chunks(len(t) - 1):
        rows = slice(rows.start, rows.stop + 1)
        last = rows.stop == len(t)
        end = len(times) if last else np.searchsorted(times, t[rows.stop - 1])
        yield slice(done, max(end, done)), rows
        done = max(end, done)
