# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Sampling times of IMU rows whose stamps have jitter.

An IMU samples by its own crystal; stamps at arrival have jitter of some milliseconds, or come in
pairs. The error of integrals is the change from row to row times the jitter: with the vibration of
an engine many times the sensor noise. Rows get even times if rate and force are smoother at these,
which they are not for an IMU that is polled at uneven times.
"""

from collections.abc import Iterable
from itertools import product

import numpy as np

from odocal_ros.data.arrays import chunks, Floats, Ints, PIECE_ROWS, runs, work_array

BLOCK_TIME = 1.0          # s, judgement: of rows whose mean shows a lost row
WINDOW_BLOCKS = 20        # judgement: duration of a mean; at 100 Hz jitter / sqrt(2000) remains
JITTER_SHARE = 2e-3       # judgement: of an interval, smallest jitter that is corrected
TESTED_ROWS = 20_000      # judgement: largest number of tested rows
TESTED_GROUPS = 40        # judgement: groups of them, whose sums give the significance
BESIDE, HERE, NODES = np.arange(-2, 3), 2, (0, 1, 3, 4)     # definition: a row amid its cubic's
LEAST_STEP = 1e-9              # s, judgement: minimum difference between rows
SURE_SIGMAS = 4.0         # statistical: significance of smoother rows: by chance once in 30,000


def even_imu_times(t: Floats, w: Floats, f: Floats) -> Floats:
    """Return the sampling times (n,), s, of rows by stamps t; w, f: (n, 3), in any unit."""
    usual = _interval(t)
    per = int(BLOCK_TIME / usual) if usual > 0 else 0
    if per < 10 or len(t) < WINDOW_BLOCKS * per:
        return t
    rhythm = _EvenTimes(t, usual, per)
    tested = np.arange(2, len(t) - 2, max(1, len(t) // TESTED_ROWS))[:, None] + BESIDE
    sent, even = t[tested], rhythm.at(t, tested)
    jitters = np.median(np.abs(sent - even)) > JITTER_SHARE * usual
    if not jitters or not _is_smoother(sent, even, (column[tested] for column in (*w.T, *f.T))):
        return t
    return rhythm.times(t)


def _interval(t: Floats) -> float:
    """Return the interval of rows, s, by the median duration of 100 intervals."""
    stretch = t[::100]
    return float(np.median(np.diff(stretch))) / 100 if len(stretch) > 1 else 0.0


class _EvenTimes:
    """
    Even times by the mean stamps of blocks without lost rows; other rows keep their stamps.

    lost : (b,) bool, blocks of ``per`` rows with a lost row in them or in an adjacent one.
    knots, late : (k,) row numbers, and their time minus row number times interval, s.
    """

    def __init__(self, t: Floats, usual: float, per: int) -> None:
        self.usual, self.per = usual, per
        mean = self._means(t)
        self.lost = np.zeros(len(mean), bool)
        # a lost row: across the block that may contain it
        jump = np.abs(mean[2:] - mean[:-2]) > usual / 2
        for shift in range(3):
            self.lost[shift:shift + len(jump)] |= jump
        lines = [self._line(mean, a, b) for a, b in runs(~self.lost)]
        self.knots, self.late = np.concatenate([np.zeros((2, 0)), *lines], axis=1)

    def _means(self, t: Floats) -> Floats:
        """Return the trimmed mean of stamp minus row number times interval, of each block, s."""
        blocks, found = len(t) // self.per, []
        for some in np.array_split(np.arange(blocks), 1 + len(t) // PIECE_ROWS):
            rows = np.arange(some[0] * self.per, (some[-1] + 1) * self.per)
            late = np.sort((t[rows] - self.usual * rows).reshape(-1, self.per), axis=1)
            found.append(late[:, self.per // 10:self.per - self.per // 10].mean(axis=1))
        return np.concatenate(found)

    def _line(self, mean: Floats, first: int, last: int) -> Floats:
        """Return knots of blocks without a loss: a line plus the deviations of windows."""
        blocks = np.arange(first, last)
        middle = (blocks + 0.5) * self.per
        slope, start = np.polyfit(middle, mean[first:last], 1) if len(blocks) > 1 \
            else (0.0, mean[first])
        off = mean[first:last] - start - slope * middle
        windows = np.array_split(blocks - first, max(1, len(blocks) // WINDOW_BLOCKS))
        by = np.array([off[window].mean() for window in windows])[[0, *range(len(windows)), -1]]
        knots = np.array([first * self.per, *(middle[window].mean() for window in windows),
                          last * self.per - 1])
        return np.stack([knots, start + slope * knots + by])

    def at(self, t: Floats, rows: Ints) -> Floats:
        """Return the times of rows, s, in the shape of ``rows``."""
        if not len(self.knots):
            return t[rows]
        even = self.usual * rows + np.interp(rows, self.knots, self.late)
        lost = self.lost[np.minimum(rows // self.per, len(self.lost) - 1)]
        return np.where(lost, t[rows], even)

    def times(self, t: Floats) -> Floats:
        """Return the times of all rows, rising, also between even times and stamps."""
        found, last = work_array(len(t)), -np.inf
        for rows in chunks(len(t)):
            own = np.arange(rows.start, rows.stop)
            part = np.maximum.accumulate(np.maximum(self.at(t, own) - LEAST_STEP * own, last))
            found[rows], last = part + LEAST_STEP * own, part[-1]
        return found


def _is_smoother(sent: Floats, even: Floats, columns: Iterable[Floats]) -> bool:
    """Return True if (m, 5) values are significantly smoother at other times than at stamps."""
    weights = _weights(sent), _weights(even)
    gain = np.zeros(len(sent))
    for near in columns:
        # with noise alone, both are its variance
        off, left = (np.einsum('mk,mk->m', near, x)**2 / (x**2).sum(axis=1) for x in weights)
        rounding = 1e-18 * (near**2).mean() + 1e-30
        gain += np.clip((off - left) / max(np.median(off + left), rounding), -10.0, 10.0)
    sums = np.array([group.sum() for group in np.array_split(gain, TESTED_GROUPS)])
    return bool(sums.mean() > SURE_SIGMAS * sums.std() / np.sqrt(len(sums)))


def _weights(times: Floats) -> Floats:
    """Return the weights for the deviation of a row from the cubic of its neighbours: (m, 5)."""
    weights = np.full(times.shape, -1.0)
    for i, j in product(NODES, NODES):
        if i != j:
            difference = times[:, i] - times[:, j]
            weights[:, i] *= (times[:, HERE] - times[:, j]) / np.where(
                difference == 0, LEAST_STEP, difference)
    weights[:, HERE] = 1.0
    return weights
