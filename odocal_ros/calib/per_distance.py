# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Error of dead reckoning per distance driven, before and after: what scale and yaw make of it."""

from collections.abc import Iterator

import numpy as np

from odocal_ros.calib.result import PerDistance
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

PIECE_LENGTHS = 100.0, 500.0, 1000.0    # m, definition: as KITTI's benchmark has them, for a road
PIECE_STARTS = 10                       # definition: of pieces, on the length of one, as there


def per_distance(way: Floats, before: Floats, after: Floats) -> tuple[PerDistance, ...]:
    """
    Return the relative error of two tracks, pinned again to a fix for each piece.

    way : (k,) m driven at each fix.   before, after : (k, 3) track less fixes, m, pinned anywhere.

    Returns
    -------
    One entry for each length that the path holds: rms of what track and fixes differ by at the end
    of a piece that begin together, the fixes' own noise at both ends in it.

    """
    return tuple(PerDistance(length, float(np.sqrt(was.mean())), float(np.sqrt(now.mean())),
                             pieces)
                 for length, pieces, (was, now) in _lengths(way, before, after))


def _lengths(way: Floats, before: Floats,
             after: Floats) -> Iterator[tuple[float, float, list[Floats]]]:
    for length in PIECE_LENGTHS:
        a, b = _ends(way, length)
        if len(a):
            squares = [((x[b] - x[a])[:, :2]**2).sum(axis=1) for x in (before, after)]
            yield length, len(a) / PIECE_STARTS, squares


def _ends(way: Floats, length: float) -> tuple[Ints, Ints]:
    """Return the rows at which pieces of a length begin and end, a tenth of it apart."""
    begin = np.arange(way[0], way[-1] - length, length / PIECE_STARTS) if len(way) else np.empty(0)
    a = np.searchsorted(way, begin)
    b = np.searchsorted(way, way[a] + length)
    whole = b < len(way)
    a, b = a[whole], b[whole]
    near = way[b] - way[a] <= 1.2 * length      # farther apart, fixes are missing in there
    return a[near], b[near]


def check_worse(way: Floats, before: Floats, after: Floats, configured: bool) -> list[Reason]:
    """
    Return CHECK_WORSE where the correction takes the track farther from the fixes, beyond chance.

    before, after, way : as for ``per_distance``.   configured : whether a nominal scale is.
    """
    for length, pieces, (was, now) in _lengths(way, before, after):
        more = now - was
        # of fewer than three pieces end to end no scatter is known, a tenth more nobody would mind
        if pieces < 3 or now.mean() < 1.1**2 * was.mean() \
                or more.mean() < REMARK_SIGMAS * more.std() / np.sqrt(pieces):
            continue
        return [Reason(Code.CHECK_WORSE, f'in {length:g} m of path the calibrated track deviates '
                       f'{np.sqrt(now.mean()):.2g} m rms from the fixes, '
                       + ('as configured' if configured else 'uncalibrated')
                       + f' {np.sqrt(was.mean()):.2g} m')]
    return []
