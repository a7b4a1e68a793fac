# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The Imu's samples that odometry has not left behind."""

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import ImuSamples
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.settings.apply_config import ApplyConfig
from odocal_ros.settings.levels import TIME_ANEW_NS, TIME_ANEW_ROWS

WILD_TURN_RATE = 100.0    # rad/s; physical: more than any gyro of a vehicle measures


class ImuStream:
    """
    Rows of the Imu, usable and rising.

    t : (n,) s since the first.   w_b, f_b : (n, 3) rad/s, m/s^2, NaN: no force is sent.
    stamp_ns : (n,).              at : the row that is reached.     zero_ns : stamp of t = 0.
    """

    def __init__(self, config: ApplyConfig) -> None:
        self._C = matrix_from_rpy(config.imu.mounting_rpy)
        self._scales = config.imu.gyro_scale, config.imu.accel_scale
        self._offset_ns = round(config.imu.time_offset * 1e9)
        self.zero_ns = 0
        self.at = 0
        self._stale = 0
        self.stamp_ns: Ints = np.empty(0, np.int64)
        self.t: Floats = np.empty(0)
        self.w_b: Floats = np.empty((0, 3))
        self.f_b: Floats = np.empty((0, 3))

    def feed(self, block: ImuSamples) -> bool:
        """Take rows; return False, nothing taken, where their time has begun anew."""
        stamp = block.stamp_ns + self._offset_ns
        good = (block.stamp_ns > 0) & (np.abs(block.w_i) < WILD_TURN_RATE).all(axis=1)
        newest = self.stamp_ns[-1] if len(self.stamp_ns) else 0
        for k in np.flatnonzero(good):
            if stamp[k] <= newest:
                good[k] = False
                self._stale = self._stale + 1 if stamp[k] < newest - TIME_ANEW_NS else self._stale
            else:
                newest, self._stale = stamp[k], 0
        if self._stale >= TIME_ANEW_ROWS:
            return False
        if not good.any():
            return True
        self.zero_ns = self.zero_ns or int(stamp[good][0])
        f_i = block.f_i[good]
        f_i = np.where((f_i == 0).all(axis=1, keepdims=True), np.nan, f_i)
        self.stamp_ns = np.append(self.stamp_ns, stamp[good])
        self.t = np.asarray((self.stamp_ns - self.zero_ns) * 1e-9, float)
        gyro, accel = self._scales
        self.w_b = np.concatenate([self.w_b, gyro * block.w_i[good] @ self._C.T])
        self.f_b = np.concatenate([self.f_b, accel * f_i @ self._C.T])
        return True

    def drop(self, row: int) -> None:
        """Forget the rows before one; what is reached must not be among them."""
        for name in ('stamp_ns', 't', 'w_b', 'f_b'):
            setattr(self, name, getattr(self, name)[row:])
        self.at = max(self.at - row, 0)
