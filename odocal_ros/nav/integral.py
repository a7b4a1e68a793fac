"""
Long columns some rows at a time: integrals, medians, row by row; to the last bit as if at once.

The Imu of a long leg is most of the memory that a computation takes, and each column as long as it
is as much again.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.data.samples import let_go

Array = NDArray[Any]
CHUNK = 2**16     # rows


def chunks(n: int, *columns: Array) -> Iterator[slice]:
    """Yield slices of n rows; what is mapped of the columns is let go after each."""
    for first in range(0, n, CHUNK):
        yield slice(first, min(first + CHUNK, n))
        let_go(*columns)


def by_row(function: Callable[..., Array], *columns: Array) -> Array:
    """Return what a function makes of each row of arrays, (n, ...) to (n,)."""
    parts = [function(*(x[rows] for x in columns)) for rows in chunks(len(columns[0]), *columns)]
    return np.concatenate(parts) if parts else function(*columns)


def by_step(function: Callable[..., Array], *columns: Array, steps: int = 1) -> Array:
    """Return what a function of rows side by side, (m, ...) to (m - steps,), makes of them all."""
    n = len(columns[0])
    if n < 1 + steps:
        return function(*columns)
    return np.concatenate([function(*(x[rows.start:rows.stop + steps] for x in columns))
                           for rows in chunks(n - steps, *columns)])


def medians(x: Floats) -> Floats:
    """Return the median of each column: (n, k) to (k,)."""
    column, found = np.empty(len(x)), []
    for k in range(x.shape[1]):
        for rows in chunks(len(x), x):
            column[rows] = x[rows, k]
        found.append(np.median(column, overwrite_input=True))
    return np.array(found)


class Integral:
    """The integral of (n, ...) by the trapezoid rule, over times that come in pieces."""

    def __init__(self) -> None:
        self.end = 0.0

    def over(self, t: Floats, x: Floats) -> Floats:
        """Return it at the times of a piece, whose first row is the last of that before."""
        out = np.empty_like(x)
        out[0] = self.end
        np.multiply((x[:-1] + x[1:]) / 2, np.diff(t).reshape(-1, *(1,) * (x.ndim - 1)),
                    out=out[1:])
        np.cumsum(out, axis=0, out=out)
        self.end = out[-1].copy()
        return out


def integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """
    Return the integral of x, (n, ...), from t[0] on, linear between rows.

    times : (m,) array, rising.   t : (n,) array, n > 1.   Returns (m, ...).
    """
    integral, out = Integral(), np.empty((len(times), *x.shape[1:]))
    for where, rows in pieces(times, t, x):
        interpolated(times[where], t[rows], integral.over(t[rows], x[rows]), out[where])
    return out


def pieces(times: Array, t: Array, *columns: Array) -> Iterator[tuple[slice, slice]]:
    """Yield slices of rising times, and of the rows of t that they lie between; all of each."""
    done = 0
    for rows in chunks(len(t) - 1, *columns):
        rows = slice(rows.start, rows.stop + 1)
        last = rows.stop == len(t)
        end = len(times) if last else np.searchsorted(times, t[rows.stop - 1])
        yield slice(done, max(end, done)), rows
        done = max(end, done)


def interpolated(times: Floats, t: Floats, x: Floats, out: Floats) -> None:
    """Write x, (n,) or (n, k), at times to out, linear between rows."""
    if x.ndim == 1:
        out[:] = np.interp(times, t, x)
        return
    for k in range(x.shape[1]):
        out[:, k] = np.interp(times, t, x[:, k])


def twice_integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return the integral of the integral of x, (n,), at times, rising: (m,)."""
    once, twice, out = Integral(), Integral(), np.empty(len(times))
    for where, rows in pieces(times, t, x):
        interpolated(times[where], t[rows], twice.over(t[rows], once.over(t[rows], x[rows])),
                     out[where])
    return out
