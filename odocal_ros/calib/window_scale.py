# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Scale of the fixes relative to dead reckoning, by the length of the window.

If fix errors do not depend on the motion, it is the same for all lengths. A receiver that filters,
dead-reckons or uses an odometer, and fixes with late stamps, have errors that depend on the motion
over seconds but not over minutes: short windows then differ.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.statistics import robust_sigma

WINDOWS = 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0     # s, definition
PARTS, FEWEST_WINDOWS = 8, 12      # judgement: parts of the leg for a sigma; windows for a result
NO_WINDOWS = np.empty((0, 4))    # definition


def window_scale(t_fix: Floats, fix_n: Floats, dead_n: Floats) -> Floats:
    """
    Return length of the windows, s, scale - 1 of the fixes, its sigma, and windows: (w, 4).

    t_fix : (k,) times of fixes, s, rising.   fix_n, dead_n : (k, 2 or more) positions by fixes and
    by dead reckoning, m. The sigma is by the scatter over parts of the leg (jackknife); it is too
    small if errors last longer than such a part.
    """
    rows = [(length, *found) for length in WINDOWS
            if (found := _scale(t_fix, fix_n[:, :2], dead_n[:, :2], length))]
    return np.array(rows) if rows else NO_WINDOWS


def _scale(t: Floats, fix: Floats, dead: Floats, length: float) -> tuple[float, float, int] | None:
    """Return scale - 1, its sigma and the number of windows of a length, half a length apart."""
    begin = np.arange(t[0], t[-1] - length, length / 2) if len(t) else np.empty(0)
    # without the last fix: by rounding, the end of the last window may be after it
    i, j = np.searchsorted(t, begin), np.searchsorted(t[:-1], begin + length)
    near = np.abs(t[j] - t[i] - length) < length / 4     # judgement: else fixes are missing
    i, j = i[near], j[near]
    chord = dead[j] - dead[i]
    size = np.hypot(*chord.T)
    i, j, chord, size = (x[size > 0] for x in (i, j, chord, size))
    if len(i) < FEWEST_WINDOWS:
        return None
    along = (chord * (fix[j] - fix[i] - chord)).sum(axis=1) / size
    most = 4 * max(robust_sigma(along), 1e-9)       # statistical: one in 16,000
    along = np.clip(along, -most, most)
    block = np.minimum((PARTS * (t[i] - t[0]) / (t[-1] - t[0])).astype(int), PARTS - 1)
    top, bottom = (np.bincount(block, x, PARTS) for x in (size * along, size**2))
    # no block may have more than half of the weight
    if (bottom > 0).sum() < PARTS / 2 or bottom.max() > bottom.sum() / 2:
        return None
    left = (top.sum() - top) / (bottom.sum() - bottom)
    sigma = np.sqrt((PARTS - 1) / PARTS * ((left - left.mean())**2).sum())
    return float(top.sum() / bottom.sum()), float(sigma), len(i)
