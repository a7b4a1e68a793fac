# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Quantisation of IMU signals: noise of a coarse output, which is no vibration."""

import numpy as np

from odocal_ros.calib.smoother.leg import SmootherLeg
from odocal_ros.data.arrays import Floats

FINEST = 1e-5           # rad/s and m/s^2, physical: finer steps are no output format that matters
SAMPLES = 20_000        # judgement: rows in which the step shows
ROWS_A_VALUE = 20       # judgement: a signal that holds so few values is quantised
EXPLAINED = 0.4         # judgement: share of the noise variance that quantisation must have


def steps(leg: SmootherLeg) -> dict[str, float]:
    """Return the quantisation steps of gyro, rad/s, and accelerometer, m/s^2; 0: none."""
    return {'gyro': _step(leg.w_b), 'accel': _step(leg.f_b)}


def explained(leg: SmootherLeg, level: dict[str, float]) -> dict[str, float]:
    """
    Return the steps of those sensors whose noise the quantisation explains.

    level : roots of the white noise levels of 'gyro' and 'accel', SI per sqrt(Hz).
    """
    interval = float(np.median(np.diff(leg.t_imu[:SAMPLES])))
    return {name: step for name, step in steps(leg).items()
            if step**2 / 12 * interval > EXPLAINED * level[name]**2}


def _step(x: Floats) -> float:
    """Return the largest step of the columns of a signal."""
    rows = x[::max(1, len(x) // SAMPLES)]
    found = 0.0
    for column in rows.T:
        values = np.unique(np.round(column / FINEST))
        if 2 < len(values) < len(rows) / ROWS_A_VALUE:
            found = max(found, float(np.median(np.diff(values))) * FINEST)
    return found
