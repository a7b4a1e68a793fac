# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
A low-pass filter in the odometer's speed: what the fit, which knows a delay, leaves of it.

A speed filtered over a time T has rolled x where the ground has passed x + T v, by its own v. The
fit takes out a delay D near T, x + D v + D^2 a / 2. What is left follows the changes of the
acceleration, by about T^2 / 2, which slip does not: it follows the acceleration.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.calib.smoother.estimate import Fit
from odocal_ros.calib.smoother.motion_rows import MotionRows
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS, NORMAL_MEDIAN

# relative, of what a filter does to a way: its order is not known, and accelerations are those of
# keyframes. Judgement
SHAPE_ERROR = 0.5
# s: a filter over less moves an interval by a centimetre at most, at 2 m/s^2. Judgement
LEAST_FILTER = 0.1


class SpeedFilter(NamedTuple):
    """A low-pass filter: its time, s, and what it does to the way of each interval, (K,) m."""

    time: float
    way: Floats

    def taken_from(self, turned: Floats) -> Floats:
        """Return what the filter does not explain of ways, (K,) m, 0 within its shape's error."""
        rest = turned - self.way
        out: Floats = np.sign(rest) * np.maximum(
            np.abs(rest) - SHAPE_ERROR * np.abs(self.way), 0.0)
        return out


def speed_filter(fit: Fit, turned: Floats) -> SpeedFilter | None:
    """
    Return the filter that the way of the odometer shows, None where it shows none.

    turned : (K,) m by which the odometer turned beyond the ground in each interval.
    """
    rows = fit.weighted[MotionRows]
    moves = (rows.noise.road[:, :2] > 0).any(axis=1)
    t, ahead = fit.state.t, fit.state.C_nb @ fit.state.forward
    # by the fit, whose accelerometer knows it better than counts do
    v = np.einsum('ki,ki->k', fit.state.v_n, ahead)
    a = np.gradient(v, t)
    # changes of acceleration, of speed (a delay) and of its square (slip by the force)
    A = np.diff(np.stack([a, v, v**2], -1), axis=0)
    if moves.sum() < 2 * A.shape[1] or not (np.ptp(A[moves], axis=0) > 0).all():
        return None
    x, sigma = _robust_line(A[moves], turned[moves])
    if x[0] < max(FAULT_SIGMAS * sigma, LEAST_FILTER**2 / 2):
        return None
    return SpeedFilter(float(np.sqrt(2 * x[0])), np.where(moves, A[:, :2] @ x[:2], 0.0))


def _robust_line(A: Floats, y: Floats) -> tuple[Floats, float]:
    """Return x of y = A x by Huber's weights, and the sigma of its first element."""
    A_scale = np.abs(A).max(axis=0)
    A, weight = A / A_scale, np.ones(len(y))
    for _ in range(20):     # passes: the weights settle in some
        normal = (A * weight[:, None]).T @ A
        x = np.linalg.lstsq(normal, (A * weight[:, None]).T @ y, rcond=None)[0]
        off = np.abs(y - A @ x)
        usual = max(float(np.median(off)) / NORMAL_MEDIAN, 1e-9)
        weight = 1 / np.maximum(off / usual, 1.0)
    sigma = usual * np.sqrt(np.linalg.pinv(normal)[0, 0])
    return x / A_scale, float(sigma / A_scale[0])


def filter_reasons(found: SpeedFilter | None) -> list[Reason]:
    """Return SPEED_FILTERED, empty without a filter."""
    if found is None:
        return []
    return [Reason(Code.SPEED_FILTERED, 'the odometer speed is low-pass filtered with a time '
                   f'constant of about {found.time:.2f} s, an error of up to '
                   f'{np.abs(found.way).max():.2f} m in one second that a delay does not explain')]
