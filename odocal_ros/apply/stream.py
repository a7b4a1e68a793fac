# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The IMU samples that the odometry still needs."""

import numpy as np

from odocal_ros.apply.spikes import beyond_sensor, single, SpikeScreen
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import ImuSamples
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.screening.glitches import ROWS_BESIDE
from odocal_ros.settings.node_configs import ApplyConfig

INTERVAL_ROWS = 64      # judgement: rows that determine the usual interval
HOLE_INTERVALS = 2.5      # judgement: usual intervals of the IMU, a longer one hides a turn
COLUMNS = ('stamp_ns', 't', 'x_b', 'strange')


class ImuStream:
    """
    Rows of the IMU, usable and rising.

    t : (n,) s since the first.   x_b : (n, 6) turn rate w_b, rad/s, and force f_b, m/s^2, NaN: no
    force is sent.
    stamp_ns : (n,).              at : the row that is reached.     zero_ns : stamp of t = 0.
    strange : (n, 3) rad/s, sizes of implausible turn rates.
    usual : s between rows.       ``notes`` receives sentences on dropped rows.
    """

    def __init__(self, config: ApplyConfig, notes: list[str]) -> None:
        C_ib = matrix_from_rpy(config.imu.mounting_rpy).T
        self._gyro, self._accel = config.imu.gyro_scale * C_ib, config.imu.accel_scale * C_ib
        self._offset_ns = round(config.imu.time_offset * 1e9)
        self._notes = notes
        self._screen = SpikeScreen()
        self._held: list[tuple[Ints, Floats]] = []     # stamps, rates and forces
        self.zero_ns = 0
        self.at = 0
        self.usual = 0.0
        self._unmeasured = 0        # rows since ``usual`` was measured
        self.stamp_ns: Ints = np.empty(0, np.int64)
        self.t: Floats = np.empty(0)
        self.x_b: Floats = np.empty((0, 6))
        self.strange: Floats = np.empty((0, 3))

    @property
    def w_b(self) -> Floats:
        """Return turn rates, (n, 3) rad/s."""
        return self.x_b[:, :3]

    @property
    def f_b(self) -> Floats:
        """Return specific forces, (n, 3) m/s^2."""
        return self.x_b[:, 3:]

    def feed(self, block: ImuSamples) -> None:
        """Take rows whose stamps rise."""
        x_b = np.empty((len(block.stamp_ns), 6))
        with np.errstate(invalid='ignore', over='ignore'):
            np.matmul(block.w_i, self._gyro, out=x_b[:, :3])
            np.matmul(block.f_i, self._accel, out=x_b[:, 3:])
        x_b[~block.f_i.any(axis=1), 3:] = np.nan
        good = ~beyond_sensor(x_b)
        self._say_dropped(len(good) - int(np.count_nonzero(good)), 'hold NaN or impossible values')
        if good.any():
            self._held.append((block.stamp_ns[good] + self._offset_ns, x_b[good]))
            self._release(*(np.concatenate(column) for column in zip(*self._held, strict=True)))

    def _release(self, stamp_ns: Ints, x_b: Floats) -> None:
        """Take rows as far as it is known that they are no spikes; hold the others."""
        self.zero_ns = self.zero_ns or int(stamp_ns[0])
        first = np.concatenate([self.stamp_ns[-1:], stamp_ns])
        t = (first - self.zero_ns) * 1e-9
        n = len(t) - len(stamp_ns)
        keep, strange, hold = self._screen.sift(t, np.concatenate([self.x_b[-1:], x_b]))
        rows = np.flatnonzero(keep[n:hold])
        later = slice(hold - n, None)
        self._held = [(stamp_ns[later], x_b[later])] if hold < len(t) else []
        self._say_dropped(hold - n - len(rows), 'jump away and back, or repeat one value')
        for name, column in zip(COLUMNS, (stamp_ns, t[n:], x_b, strange[n:]), strict=True):
            setattr(self, name, np.concatenate([getattr(self, name), column[rows]]))
        self._drop_single(len(rows))
        self._unmeasured += len(rows)
        few = len(self.t) < INTERVAL_ROWS
        if len(self.t) > 1 and (few or self._unmeasured > INTERVAL_ROWS // 4):
            self.usual, self._unmeasured = float(np.median(np.diff(self.t[-INTERVAL_ROWS:]))), 0

    def _drop_single(self, new: int) -> None:
        """Drop rows that are off alone; it shows once the next one has come."""
        begin = max(len(self.t) - new - ROWS_BESIDE - 3, 0)
        off = np.flatnonzero(single(self.x_b[begin:])) + begin
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
