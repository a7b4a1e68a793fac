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

from odocal_ros.data.arrays import CHUNK_ROWS, chunks, Floats, Ints, runs, work_array

BLOCK_TIME = 1.0          # s, judgement: duration of rows whose mean time shows a lost row
WINDOW_BLOCKS = 20        # judgement: blocks of a mean; at 100 Hz jitter / sqrt(2000) remains
JITTER_SHARE = 2e-3       # judgement: smallest jitter that is corrected, over the interval
TESTED_ROWS = 20_000      # judgement: largest number of tested rows
TESTED_GROUPS = 40        # judgement: groups of them, whose sums give the significance
# definition: a row and the two before and after it, whose cubic predicts its values
OFFSETS, MIDDLE, NEIGHBOURS = np.arange(-2, 3), 2, (0, 1, 3, 4)
MIN_STEP = 1e-9         # s, judgement: minimum difference between rows
REGULAR_SIGMAS = 4.0     # statistical: significance of smoother rows: by chance once in 30,000


def even_imu_times(t: Floats, w: Floats, f: Floats) -> Floats:
    """Return the sampling times (n,), s, of rows by stamps t; w, f: (n, 3), in any unit."""
    every_100th = t[::100]
    interval = float(np.median(np.diff(every_100th))) / 100 if len(every_100th) > 1 else 0.0
    block_rows = int(BLOCK_TIME / interval) if interval > 0 else 0
    if block_rows < 10 or len(t) < WINDOW_BLOCKS * block_rows:
        return t
    even_times = _EvenTimes(t, interval, block_rows)
    # (m, 5) tested rows with their neighbours
    tested = np.arange(2, len(t) - 2, max(1, len(t) // TESTED_ROWS))[:, None] + OFFSETS
    stamps, even = t[tested], even_times.times_of(t, tested)
    has_jitter = np.median(np.abs(stamps - even)) > JITTER_SHARE * interval
    values = (column[tested] for column in (*w.T, *f.T))
    return even_times.all_times(t) if has_jitter and _is_regular(stamps, even, values) else t


class _EvenTimes:
    """
    Even times by the mean stamps of blocks without lost rows; other rows keep their stamps.

    interval : s between rows.   block_rows : rows of a block.
    has_loss : (b,) bool, blocks with a lost row in them or in an adjacent one.
    knots, lateness : (k,) row numbers, and their time minus row number times interval, s.
    """

    def __init__(self, t: Floats, interval: float, block_rows: int) -> None:
        self.interval, self.block_rows = interval, block_rows
        lateness = self._mean_lateness(t)
        self.has_loss = np.zeros(len(lateness), bool)
        # a lost row changes the lateness by an interval, across the block that contains it
        jump = np.abs(lateness[2:] - lateness[:-2]) > interval / 2
        for shift in range(3):
            self.has_loss[shift:shift + len(jump)] |= jump
        lines = [self._line(lateness, first, end) for first, end in runs(~self.has_loss)]
        self.knots, self.lateness = np.concatenate([np.zeros((2, 0)), *lines], axis=1)

    def _mean_lateness(self, t: Floats) -> Floats:
        """Return the trimmed mean of stamp minus row number times interval, of each block, s."""
        n, means = self.block_rows, []
        for chunk in np.array_split(np.arange(len(t) // n), 1 + len(t) // CHUNK_ROWS):
            rows = np.arange(chunk[0] * n, (chunk[-1] + 1) * n)
            lateness = np.sort((t[rows] - self.interval * rows).reshape(-1, n), axis=1)
            means.append(lateness[:, n // 10:n - n // 10].mean(axis=1))
        return np.concatenate(means)

    def _line(self, lateness: Floats, first: int, end: int) -> Floats:
        """Return knots and lateness of blocks without a loss: a line plus means of windows."""
        blocks = np.arange(first, end)
        middle = (blocks + 0.5) * self.block_rows
        slope, start = np.polyfit(middle, lateness[first:end], 1) if len(blocks) > 1 \
            else (0.0, lateness[first])
        residual = lateness[first:end] - start - slope * middle
        windows = np.array_split(blocks - first, max(1, len(blocks) // WINDOW_BLOCKS))
        means = np.array([residual[window].mean() for window in windows])
        knots = np.array([first * self.block_rows, *(middle[window].mean() for window in windows),
                          end * self.block_rows - 1])
        return np.stack([knots, start + slope * knots + np.pad(means, 1, mode='edge')])

    def times_of(self, t: Floats, rows: Ints) -> Floats:
        """Return the times of rows, s, in the shape of ``rows``; their stamps t near a loss."""
        if not len(self.knots):
            return t[rows]
        even = self.interval * rows + np.interp(rows, self.knots, self.lateness)
        has_loss = self.has_loss[np.minimum(rows // self.block_rows, len(self.has_loss) - 1)]
        return np.where(has_loss, t[rows], even)

    def all_times(self, t: Floats) -> Floats:
        """Return the times of all rows with stamps t, strictly rising: (n,) s."""
        even_times, last = work_array(len(t)), -np.inf
        for chunk in chunks(len(t)):
            rows = np.arange(chunk.start, chunk.stop)
            times = self.times_of(t, rows) - MIN_STEP * rows
            times = np.maximum.accumulate(np.maximum(times, last))
            even_times[chunk], last = times + MIN_STEP * rows, times[-1]
        return even_times


def _is_regular(stamps: Floats, even: Floats, columns: Iterable[Floats]) -> bool:
    """Return True if (m, 5) values are significantly smoother at even times than at stamps, s."""
    weights = _weights(stamps), _weights(even)
    gain = np.zeros(len(stamps))
    for values in columns:
        # squared deviations from the cubic; with white noise alone, both have its variance
        at_stamps, at_even = (np.einsum('mk,mk->m', values, x)**2 / (x**2).sum(axis=1)
                              for x in weights)
        rounding = 1e-18 * (values**2).mean() + 1e-30
        gain += np.clip((at_stamps - at_even) / max(np.median(at_stamps + at_even), rounding),
                        -10.0, 10.0)
    sums = np.array([group.sum() for group in np.array_split(gain, TESTED_GROUPS)])
    return bool(sums.mean() > REGULAR_SIGMAS * sums.std() / np.sqrt(len(sums)))


def _weights(times: Floats) -> Floats:
    """Return the weights for the deviation of a row from the cubic of its neighbours: (m, 5)."""
    weights = np.full(times.shape, -1.0)
    for i, j in product(NEIGHBOURS, NEIGHBOURS):
        if i != j:
            difference = times[:, i] - times[:, j]
            weights[:, i] *= (times[:, MIDDLE] - times[:, j]) / np.where(
                difference == 0, MIN_STEP, difference)
    weights[:, MIDDLE] = 1.0
    return weights
