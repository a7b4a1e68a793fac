# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
What of the IMU's signals its errors multiply: docs/method.md, noise in the regressor.

Derivatives by a scale error go by a signal. By the signal as measured they hold its noise, which
the fit then takes for information, and a smaller signal for a better one. So, once the state is so
near that residuals are noise, that is taken out: what an axis has put into the residual, and,
since the noise of a gyro turns the force within an interval, what gravity makes of that.

Heave and the rates of pitch and roll are more than noise, but nothing drives them from second to
second but the road, and it is by the road's noise that the fit judges them: again a smaller signal
is a better one. Of these only what lasts is a signal.
"""


import numpy as np

from odocal_ros.calib.smoother.motion import Motion, ROWS
from odocal_ros.calib.smoother.preintegrate import turn
from odocal_ros.calib.smoother.state import (
    ACCEL,
    ACCEL_AXIS,
    ACCEL_SIGNAL,
    BG,
    GYRO,
    GYRO_AXIS,
    GYRO_SIGNAL,
    P,
    PHI,
    V,
)
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import transpose

# s, running mean. Tuned: over 4 s a swaying consumer Imu's vertical scale is 1.8 sigmas of its
# grade off in 30 minutes, over 10 s 0.5, over 20 s 0.4 (docs/decisions/0009)
LASTING = 10.0
UPRIGHT = 2     # definition: the axis whose force is gravity and heave, whose rate is the turn's


class Signals:
    """
    Turn rate and force of a motion's intervals, as fitted, with only what lasts of the road's.

    rate, force : (K, 3) in b, means of the intervals.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        back, up_b, T = transpose(motion.C), motion.C[:, 2], motion.T
        rate = motion.sums.mean_rate + turn(back, motion.residual[:, PHI]) / T
        force = motion.sums.mean_force + turn(back, motion.residual[:, V]) / T
        turning, heave = ((x * up_b).sum(axis=1, keepdims=True) for x in (rate, force))
        rolling = rate - turning * up_b
        self.rate = rate + lasting(rolling, T[:, 0]) - rolling
        self.force = force + (lasting(heave, T[:, 0]) - heave) * up_b

    def fit(self, rows: slice, constants: Floats, by_bias: Floats, gyro: Floats,
            found: Floats) -> None:
        """
        Put the derivatives by the IMU's errors right, in constants: (k, 18, M).

        rows : slice of the intervals.   by_bias : (k, 18, 3) derivatives by the gyro's bias.
        gyro : (k, 18, 3 p) columns of the gyro's unit noises, along the axes of n at p points.
        found : (k, 3 p) their best estimates. The noises of two sensors are independent, so the
        forces that act on the gyro are left.
        """
        part = self.motion.take(rows)
        self._by_rates(part, rows, constants[:, :, GYRO], by_bias)
        k, C = len(part.C), part.C[:, None]
        # of the noise about each axis of b
        of_gyro = ((gyro.reshape(k, ROWS, -1, 3) @ C) * (found.reshape(k, 1, -1, 3) @ C)).sum(2)
        for axes, size in ((V, part.sums.A), (P, part.sums.AA)):
            self._by_forces(part, constants[:, axes, ACCEL], size * self.force[rows, None, 2:],
                            part.residual[:, axes], of_gyro[:, axes])

    def _by_rates(self, part: Motion, rows: slice, columns: Floats, by_bias: Floats) -> None:
        """Put the derivatives right that go by turn rates: columns (k, 18, g)."""
        noise = turn(transpose(part.C), part.residual[:, PHI]) / part.T
        by_bias = by_bias.copy()
        by_bias[:, BG] = 0.0        # which walks, as a scale does not
        for i, (into, by) in enumerate(zip(GYRO_AXIS, GYRO_SIGNAL, strict=True)):
            if by == UPRIGHT:
                columns[:, :, i] += by_bias[:, :, into] * noise[:, by, None]
            elif by < UPRIGHT:
                columns[:, :, i] = by_bias[:, :, into] * self.rate[rows, by, None]

    def _by_forces(self, part: Motion, columns: Floats, upright: Floats, residual: Floats,
                   of_gyro: Floats) -> None:
        """
        Put the derivatives of velocity, or of place, right that go by forces: columns (k, 3, a).

        upright : (k, 3, 3) those by what lasts of the upright force, by the axis it enters.
        of_gyro : (k, 3, 3) what the gyro's noise about each axis of b put into the residual.
        """
        back = transpose(part.C)
        turned = back @ of_gyro      # toward an axis of b, about one
        own = turn(back, residual) - turned.sum(axis=2)
        for i, (into, by) in enumerate(zip(ACCEL_AXIS, ACCEL_SIGNAL, strict=True)):
            noise = np.zeros_like(own)
            if by == UPRIGHT:
                columns[:, :, i] = turn(part.C, upright[:, :, into])
            else:
                noise[:, into] = own[:, by]
            if into == by:      # the force along it, turned about another, toward the third
                for about, toward in ((into - 1, into - 2), (into - 2, into - 1)):
                    noise[:, toward] += turned[:, toward, about]
            columns[:, :, i] += turn(part.C, noise)


def lasting(x: Floats, T: Floats) -> Floats:
    """Return running means over LASTING of values (K, d) of intervals of T (K,) s."""
    n = max(1, round(LASTING / 2 / float(np.median(T))))
    padded = np.concatenate([np.repeat(x[:1], n + 1, axis=0), x, np.repeat(x[-1:], n, axis=0)])
    total = np.cumsum(padded, axis=0)
    out: Floats = (total[2 * n + 1:] - total[:-2 * n - 1]) / (2 * n + 1)
    return out
