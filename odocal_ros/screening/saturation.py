# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of an axis of the IMU at the limit of its range."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import columns
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.grades import G

# physical: smaller than any range, larger than gravity at rest
LEAST_GYRO, LEAST_ACCELEROMETER = 1.0, 1.5 * G      # rad/s, m/s^2
# statistical: coarse steps also repeat the largest value, but less often than the next smaller one
FEWEST_AT_LIMIT, TIMES_NEXT = 5, 3.0


def saturated(t_imu: Floats, w_i: Floats, f_i: Floats, imu: ImuConfig) -> tuple[Reason, ...]:
    """
    Return IMU_SATURATED for the axis that is at its limit most often.

    t_imu : (n,) s.   w_i, f_i : (n, 3) raw turn rates and specific forces.
    """
    found = []
    for sensor, x_i, scale, unit, least in (
            ('gyro', w_i, imu.gyro_scale, 'rad/s', LEAST_GYRO),
            ('accelerometer', f_i, imu.accel_scale, 'm/s^2', LEAST_ACCELEROMETER)):
        for axis, x in zip('xyz', columns(x_i), strict=True):
            for peak, inside, none in ((np.max, np.less, -np.inf), (np.min, np.greater, np.inf)):
                limit = peak(x, initial=0.0)
                at = x == limit
                count, size = int(np.count_nonzero(at)), abs(limit * scale)
                if size < least or count < FEWEST_AT_LIMIT:
                    continue
                following = peak(x, where=inside(x, limit), initial=none)
                if count > TIMES_NEXT * np.count_nonzero(x == following):
                    found.append((count, float(t_imu[at.argmax()]),
                                  f'{sensor} {axis} saturates at {limit * scale:+.4g} {unit}'))
    if not found:
        return ()
    count, t, words = max(found)
    others = f'; {len(found) - 1} more such limits' if len(found) > 1 else ''
    return (Reason(Code.IMU_SATURATED, f'{words} in {count} of {len(t_imu)} messages, first at '
                   f't = {t:.1f} s{others}'),)
