# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""IMU samples of a leg as rows between keyframes, and the IMU's own errors in them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.smoother.leg import SmootherLeg
from odocal_ros.calib.smoother.state import (
    ACCEL,
    ACCEL_AXIS,
    ACCEL_SIGNAL,
    GYRO,
    GYRO_AXIS,
    GYRO_SIGNAL,
)
from odocal_ros.data.arrays import Ints
from odocal_ros.data.mapped import let_go
from odocal_ros.nav.strapdown import rotation_increments

Floats = NDArray[np.float64]


def keyframes(t: Floats, t_begin: float, t_end: float, spacing: float) -> Ints:
    """Return indices of the samples nearest to an even grid of times: (K + 1,), rising."""
    first, last = np.searchsorted(t, t_begin), np.searchsorted(t, t_end, side='right') - 1
    count = max(1, round((t[last] - t[first]) / spacing))
    grid = np.linspace(t[first], t[last], count + 1)
    k = np.clip(np.searchsorted(t, grid), first, last)
    earlier = np.maximum(k - 1, first)
    k = np.where(grid - t[earlier] < t[k] - grid, earlier, k)
    return np.unique(k)


@dataclass(frozen=True, eq=False)
class SomeRows:
    """IMU samples between some keyframes, first and last with them."""

    t: Floats           # (n,)
    f_b: Floats         # (n, 3)
    turn: Floats        # (n - 1, 3) rotation vectors between samples, bias and all
    key: NDArray[np.int64]   # (k + 1,) samples that are keyframes


@dataclass(frozen=True, eq=False)
class ImuRows:
    """
    IMU samples of the leg.

    Rotation vectors are made of the turn rates anew in each pass: those of hours are 0.2 GB.
    """

    t: Floats           # (n,)
    f_b: Floats         # (n, 3)
    w_b: Floats         # (n, 3)
    key: NDArray[np.int64]   # (K + 1,) samples that are keyframes

    @classmethod
    def of(cls, leg: SmootherLeg, spacing: float) -> 'ImuRows':
        """Return the rows of a leg between its begin and stop."""
        key = keyframes(leg.t_imu, leg.t_begin, leg.t_stop, spacing)
        rows = slice(key[0], key[-1] + 1)
        t = leg.t_imu[rows]
        return cls(t, leg.f_b[rows], leg.w_b[rows], key - key[0])

    def parts(self) -> Iterator[tuple[int, int, SomeRows]]:
        """Yield first and last of the keyframes of some intervals, and their rows."""
        K, at_a_time = len(self.key) - 1, 8192      # rows, whose arrays stay in the cache
        per = max(1, int(at_a_time * K / (self.key[-1] - self.key[0] + 1)))
        for first in range(0, K, per):
            last = min(first + per, K)
            yield first, last, self.between(first, last)
            let_go()

    def between(self, first: int, last: int) -> SomeRows:
        """Return the rows from one keyframe to another."""
        a, b = self.key[first], self.key[last]
        return SomeRows(self.t[a:b + 1], self.f_b[a:b + 1], self.turns(a, b),
                        self.key[first:last + 1] - a)

    def turns(self, begin: int = 0, end: int | None = None) -> Floats:
        """Return the rotation vectors of some steps, bias and all: (m, 3)."""
        return rotation_increments(self.t, self.w_b, begin, end).T

    def over_intervals(self, function: Callable[[SomeRows], Floats]) -> Floats:
        """Return what a function of SomeRows gives for each interval: (K, ...)."""
        return np.concatenate([function(rows) for _, _, rows in self.parts()])

    def turned(self) -> Floats:
        """Return the sum of the rotation vectors over each interval: (K, 3)."""
        return self.over_intervals(lambda rows: np.add.reduceat(rows.turn, rows.key[:-1]))


def mended(imu: SomeRows, constants: Floats | None) -> tuple[Floats, Floats]:
    """Return turns (n - 1, 3), rad, and forces (n, 3) without M of docs/method.md (S3)."""
    if constants is None or not (constants[GYRO].any() or constants[ACCEL].any()):
        return imu.turn, imu.f_b
    gyro, accel = np.zeros((3, 6)), np.zeros((3, 3))
    gyro[GYRO_AXIS, GYRO_SIGNAL] = constants[GYRO]
    accel[ACCEL_AXIS, ACCEL_SIGNAL] = constants[ACCEL]
    by = signals(imu.turn, imu.f_b, np.diff(imu.t))
    return imu.turn - by @ gyro.T, imu.f_b - imu.f_b @ accel.T


def signals(turn: Floats, f_b: Floats, dt: Floats) -> Floats:
    """
    Return what the gyro's errors go by over each step: turns, rad, and forces times s: (n - 1, 6).

    turn, f_b, dt : (n - 1, 3) rad, (n, 3) m/s^2, (n - 1,) s.
    """
    return np.concatenate([turn, (f_b[:-1] + f_b[1:]) / 2 * dt[:, None]], axis=1)
