# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Error of dead reckoning by path length, before and after the correction of scale and yaw."""

from collections.abc import Iterator

import numpy as np

from odocal_ros.calib.result import PerDistance
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

PIECE_LENGTHS = 100.0, 500.0, 1000.0    # m, definition: as in KITTI's benchmark, for roads
PIECE_STARTS = 10                       # definition: of pieces, on the length of one, as there


def per_distance(path: Floats, before: Floats, after: Floats) -> tuple[PerDistance, ...]:
    """
    Return the errors of two tracks over pieces of the path, each set to the fix at its begin.

    path : (k,) path length at each fix, m.   before, after : (k, 3) track minus fixes, m, up to a
    constant.

    Returns
    -------
    An entry for each length in the path: rms difference at the ends, with the noise of the fixes.

    """
    return tuple(PerDistance(length, float(np.sqrt(was.mean())), float(np.sqrt(now.mean())),
                             pieces)
                 for length, pieces, (was, now) in _lengths(path, before, after))


def _lengths(path: Floats, before: Floats,
             after: Floats) -> Iterator[tuple[float, float, list[Floats]]]:
    for length in PIECE_LENGTHS:
        a, b = _ends(path, length)
        if len(a):
            squares = [((x[b] - x[a])[:, :2]**2).sum(axis=1) for x in (before, after)]
            yield length, len(a) / PIECE_STARTS, squares


def _ends(path: Floats, length: float) -> tuple[Ints, Ints]:
    """Return first and last rows of pieces of a length, whose begins are a tenth of it apart."""
    begin = np.arange(path[0], path[-1] - length,
                      length / PIECE_STARTS) if len(path) else np.empty(0)
    a = np.searchsorted(path, begin)
    b = np.searchsorted(path, path[a] + length)
    whole = b < len(path)
    a, b = a[whole], b[whole]
    near = path[b] - path[a] <= 1.2 * length      # in longer ones fixes are missing
    return a[near], b[near]


def check_worse(path: Floats, before: Floats, after: Floats, configured: bool) -> list[Reason]:
    """
    Return CHECK_WORSE if the correction significantly increases the distance to the fixes.

    before, after, path : as for ``per_distance``.   configured : a nominal scale is configured.
    """
    for length, pieces, (was, now) in _lengths(path, before, after):
        more = now - was
        # fewer than three pieces end to end have no known scatter; a tenth more is acceptable
        if pieces < 3 or now.mean() < 1.1**2 * was.mean() \
                or more.mean() < REMARK_SIGMAS * more.std() / np.sqrt(pieces):
            continue
        return [Reason(Code.CHECK_WORSE, f'in sections of {length:g} m the calibrated track '
                       f'deviates {np.sqrt(now.mean()):.2g} m rms from the fixes, the '
                       + ('track as configured' if configured else 'uncalibrated track')
                       + f' {np.sqrt(was.mean()):.2g} m')]
    return []
