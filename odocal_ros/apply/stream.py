# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The IMU samples that the odometry still needs."""

import numpy as np

from odocal_ros.apply.spikes import beyond_sensor, single, SpikeScreen
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import ImuSamples
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.screening.glitches import ROWS_BESIDE
from odocal_ros.settings.apply_config import ApplyConfig

INTERVAL_ROWS = 64      # judgement: rows that determine the usual interval
HOLE_INTERVALS = 2.5      # judgement: usual intervals of the IMU, a longer one hides a turn
COLUMNS = ('stamp_ns', 't', 'w_b', 'f_b', 'strange')


class ImuStream:
    """
    Rows of the IMU, usable and rising.

    t : (n,) s since the first.   w_b, f_b : (n, 3) rad/s, m/s^2, NaN: no force is sent.
    stamp_ns : (n,).              at : the row that is reached.     zero_ns : stamp of t = 0.
    strange : (n, 3) rad/s, sizes of implausible turn rates.
    usual : s between rows.       ``notes`` receives sentences on dropped rows.
    """

    def __init__(self, config: ApplyConfig, notes: list[str]) -> None:
        self._C = matrix_from_rpy(config.imu.mounting_rpy)
        self._scales = config.imu.gyro_scale, config.imu.accel_scale
        self._offset_ns = round(config.imu.time_offset * 1e9)
        self._notes = notes
        self._screen = SpikeScreen()
        self._held: list[tuple[Ints, Floats, Floats]] = []     # stamps, rates, forces
        self.zero_ns = 0
        self.at = 0
        self.usual = 0.0
        self._unmeasured = 0        # rows since ``usual`` was measured
        self.stamp_ns: Ints = np.empty(0, np.int64)
        self.t: Floats = np.empty(0)
        self.w_b: Floats = np.empty((0, 3))
        self.f_b: Floats = np.empty((0, 3))
        self.strange: Floats = np.empty((0, 3))

    def feed(self, block: ImuSamples) -> None:
        """Take rows whose stamps rise."""
        gyro, accel = self._scales
        f_i = np.where((block.f_i == 0).all(axis=1, keepdims=True), np.nan, block.f_i)
        with np.errstate(invalid='ignore', over='ignore'):
            w_b, f_b = gyro * block.w_i @ self._C.T, accel * f_i @ self._C.T
        good = ~beyond_sensor(w_b, f_b)
        self._say_dropped(len(good) - int(good.sum()), 'hold NaN or impossible values')
        if good.any():
            self._held.append((block.stamp_ns[good] + self._offset_ns, w_b[good], f_b[good]))
            self._release(*(np.concatenate(column) for column in zip(*self._held, strict=True)))

    def _release(self, stamp_ns: Ints, w_b: Floats, f_b: Floats) -> None:
        """Take rows as far as it is known that they are no spikes; hold the others."""
        self.zero_ns = self.zero_ns or int(stamp_ns[0])
        first = np.append(self.stamp_ns[-1:], stamp_ns)
        t = np.asarray((first - self.zero_ns) * 1e-9, float)
        n = len(t) - len(stamp_ns)
        x = np.hstack([np.concatenate([self.w_b[-1:], w_b]), np.concatenate([self.f_b[-1:], f_b])])
        keep, strange, hold = self._screen.sift(t, x)
        rows = np.flatnonzero(keep[n:hold])
        later = slice(hold - n, None)
        self._held = [(stamp_ns[later], w_b[later], f_b[later])] if hold < len(t) else []
        self._say_dropped(hold - n - len(rows), 'jump away and back, or repeat one value')
        for name, column in (('stamp_ns', stamp_ns), ('t', t[n:]), ('w_b', w_b), ('f_b', f_b),
                             ('strange', strange[n:])):
            setattr(self, name, np.concatenate([getattr(self, name), column[rows]]))
        self._drop_single(len(rows))
        self._unmeasured += len(rows)
        few = len(self.t) < INTERVAL_ROWS
        if len(self.t) > 1 and (few or self._unmeasured > INTERVAL_ROWS // 4):
            self.usual, self._unmeasured = float(np.median(np.diff(self.t[-INTERVAL_ROWS:]))), 0

    def _drop_single(self, new: int) -> None:
        """Drop rows that are off alone; it shows once the next one has come."""
        begin = max(len(self.t) - new - ROWS_BESIDE - 3, 0)
        off = np.flatnonzero(single(np.hstack([self.w_b[begin:], self.f_b[begin:]]))) + begin
        off = off[off > max(self.at, len(self.t) - new - 2)]
        self._say_dropped(len(off), 'are isolated outliers')
        for name in COLUMNS if len(off) else ():
            setattr(self, name, np.delete(getattr(self, name), off, axis=0))

    def _say_dropped(self, rows: int, why: str) -> None:
        if rows:
            self._notes.append(f'IMU messages {why}: {rows} dropped and interpolated')

    def forget(self, seconds: float) -> None:
        """Forget rows older than so much before the newest, while nothing is reached."""
        if len(self.t) and self.t[-1] - self.t[0] > 2 * seconds:
            self.drop(int(np.searchsorted(self.t, self.t[-1] - seconds)))

    def drop(self, row: int) -> None:
        """Forget the rows before one; what is reached must not be among them."""
        for name in COLUMNS:
            setattr(self, name, getattr(self, name)[row:])
        self.at = max(self.at - row, 0)
