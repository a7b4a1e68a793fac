"""Where a stream of rows pauses."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import by_step

MISSING_INTERVALS = 2.5  # median intervals: a message or more is missing
GAP_INTERVALS = 5.0      # of the median interval: what is longer is a gap
SHORTEST_GAP = 0.2       # s
FEWEST_INTERVALS = 10    # rows that show a rhythm


def gaps_longer(t: Floats, limit: float) -> Floats:
    """Return begin and end of the steps of times, (n,) s, longer than ``limit`` s: (k, 2)."""
    k = np.flatnonzero(by_step(lambda t: np.diff(t) > limit, t))
    return np.stack([t[k], t[k + 1]], -1)


def gaps_in_rhythm(t: Floats) -> Floats:
    """Return begin and end of the steps far beyond the stream's own rhythm: (k, 2) s."""
    if len(t) < FEWEST_INTERVALS:
        return np.empty((0, 2))
    return gaps_longer(t, max(GAP_INTERVALS * float(np.median(np.diff(t))), SHORTEST_GAP))
