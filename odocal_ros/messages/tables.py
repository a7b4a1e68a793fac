# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Decode many serialised messages at once: those of one layout are read as columns.

What has no layout (big endian, unknown type, damaged) is left to the caller.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.messages import cdr
from odocal_ros.messages.cdr import Layout
from odocal_ros.messages.raws import Raws, Rows, Table

# judgement: per call; a stream with more is odd enough to be read message by message
MAX_LAYOUTS = 16


def tables(msgtype: str, raws: Sequence[bytes]) -> Iterator[tuple[Layout | None, Rows, Table]]:
    """
    Sort messages by layout.

    Yields
    ------
    Layout, where its rows stand (numbers, or a slice: all of them) and the messages, (n, size)
    bytes. Rows that have no layout come last, with None and no messages.

    """
    raws = Raws.of(raws)
    odd: list[Ints] = []
    for rows in raws.by_size():
        table = raws.table(rows)
        for _ in range(MAX_LAYOUTS):
            layout = cdr.layout_of(msgtype, table[0].tobytes())
            alike = _same(table, layout.fixed if layout else [(0, table.shape[1])])
            whole = bool(alike.all())
            if layout is None:
                odd.append(rows[alike])
            elif whole:
                yield layout, slice(None) if len(rows) == len(raws) else rows, table
            else:
                yield layout, rows[alike], table[alike]
            if whole:
                break
            rows, table = rows[~alike], table[~alike]
        else:
            odd.append(rows)
    if odd:
        yield None, np.sort(np.concatenate(odd)), np.empty((0, 0), np.uint8)


def _same(table: Table, fixed: Sequence[tuple[int, int]]) -> Bools:
    """Return a mask of messages of one length whose layout bytes equal those of the first."""
    alike = np.ones(len(table), bool)
    for start, stop in fixed:
        part = table[:, start:stop]
        if stop - start in (2, 4, 8):
            number = part.view(f'u{stop - start}')[:, 0]
            alike &= number == number[0]
        else:
            alike &= (part == part[0]).all(axis=1)
    return alike


def columns(layout: Layout, table: Table, paths: Sequence[str]) -> NDArray[Any] | None:
    """
    Return the values at some paths.

    Returns
    -------
    (n, len(paths)) array of the first path's dtype; None where a path is not in the layout.

    """
    runs = layout.runs(tuple(paths))
    if runs is None:
        return None
    # all of a run at a time, not value by value
    values = [table[:, run.place].view(run.together).copy().view(run.dtype).reshape(-1, run.width)
              for run in runs]
    return values[0] if len(values) == 1 else np.concatenate(values, axis=1)
