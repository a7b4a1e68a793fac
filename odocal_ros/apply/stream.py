# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The IMU rows of a stream that dead reckoning still needs."""

from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise

from odocal_ros.apply import spikes
from odocal_ros.apply.attitude import rotated
from odocal_ros.data.samples import NO_FORCE, Reading
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.settings.node_configs import ApplyConfig

INTERVAL_ROWS = 64      # judgement: rows of the median interval
HOLE_INTERVALS = 2.5      # judgement: median intervals; in a longer gap a turn is not measured


class ImuStream:
    """
    Usable rows of the IMU in order of time.

    at : current row of the path.   zero_ns : stamp of t = 0.   usual : s, median interval.
    notes : list for texts on dropped rows.
    """

    def __init__(self, config: ApplyConfig, notes: list[str]) -> None:
        C_bi = matrix_from_rpy(config.imu.mounting_rpy)
        self._gyro = (config.imu.gyro_scale * C_bi).tolist()
        self._accel = (config.imu.accel_scale * C_bi).tolist()
        self._offset_ns = round(config.imu.time_offset * 1e9)
        self._notes = notes
        self._screen = spikes.SpikeScreen()
        self._held: list[spikes.Row] = []
        self.rows: list[spikes.Row] = []
        self.zero_ns = 0
        self.at = 0
        self.usual = 0.0
        self._unmeasured = 0        # rows since ``usual`` was measured

    def feed(self, readings: Sequence[Reading]) -> None:
        """Add rows with rising stamps; possible spikes are held until the next call."""
        rows, before = self._held, len(self._held)
        for stamp, _, w_i, f_i, *_ in readings:
            w_b, f_b = rotated(self._gyro, w_i), rotated(self._accel, f_i)
            if not any(f_i) or sum(f_b) != sum(f_b):
                f_b = NO_FORCE
            if spikes.is_possible(w_b, f_b):
                self.zero_ns = self.zero_ns or stamp + self._offset_ns
                stamp += self._offset_ns
                rows.append(spikes.Row((stamp - self.zero_ns) * 1e-9, stamp, w_b, f_b))
        self._say_dropped(before + len(readings) - len(rows),
                          'hold NaN or impossible values')
        kept, self._held = self._screen.sift(rows)
        self._say_dropped(len(rows) - len(kept) - len(self._held),
                          'jump and return, or repeat one value')
        for row in kept:
            self.rows.append(row)
            if len(self.rows) - 2 > self.at and spikes.is_single(self.rows[-spikes.SINGLE_ROWS:]):
                self._say_dropped(1, 'are isolated outliers')
                del self.rows[-2]
        self._unmeasured += len(kept)
        few = len(self.rows) < INTERVAL_ROWS
        if len(self.rows) > 1 and (few or self._unmeasured > INTERVAL_ROWS // 4):
            steps = sorted(b.t - a.t for a, b in pairwise(self.rows[-INTERVAL_ROWS:]))
            self.usual, self._unmeasured = steps[len(steps) // 2], 0

    def _say_dropped(self, rows: int, why: str) -> None:
        if rows:
            self._notes.append(f'{rows} IMU messages dropped and interpolated: they {why}')

    def forget(self, seconds: float) -> None:
        """Drop rows more than ``seconds`` older than the newest; for use before a path exists."""
        if self.rows and self.rows[-1].t - self.rows[0].t > 2 * seconds:
            self.drop(self.from_time(self.rows[-1].t - seconds))

    def from_time(self, t: float, low: int = 0) -> int:
        """Return the number of the first row at or after t, s, not before row ``low``."""
        return bisect_left(self.rows, t, low, key=spikes.time_of)

    def drop(self, row: int) -> None:
        """Drop the rows before a row; the current row must not be one of them."""
        del self.rows[:row]
        self.at = max(self.at - row, 0)
