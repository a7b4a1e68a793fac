# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of units and axes of an IMU at rest or on average."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import by_row, chunks, lengths, medians
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.grades import G
from odocal_ros.settings.levels import RAD_PER_DEG

AXES = 'xyz'
# nothing follows from such an IMU; what is computed all the same says it in other words
UNUSABLE = {Code.NO_IMU, Code.IMU_AXES, Code.IMU_UNITS}
MAX_RATE = 8.0                  # rad/s, physical: no vehicle on wheels turns so fast


def imu_sanity(mean: Floats, w_b: Floats, C_bi: Floats,
               imu: ImuConfig) -> tuple[tuple[Reason, ...], bool]:
    """
    Judge units and axes of an IMU.

    mean : (3,) specific force as it usually is (its median), m/s^2, in the configured body
    frame.   w_b : (n, 3) turn rate there, rad/s.   C_bi : (3, 3) nominal rotation configured.
    imu : its scales are in the figures already.

    Returns
    -------
    reasons, and whether the body frame must be turned over (z down) to be used. Of what is
    UNUSABLE there is nothing to compute with.

    """
    rest, size = medians(w_b), float(np.linalg.norm(mean))
    fast = float(np.percentile(by_row(lambda w: lengths(w - rest), w_b), 99.9,
                               overwrite_input=True))
    reasons = []
    if not any(w_b[some].any() for some in chunks(len(w_b))):   # what messages hold that have none
        reasons.append(Reason(Code.NO_IMU, 'all turn rates are zero: the IMU publishes none, or '
                              'imu.gyro_scale is 0'))
    no_gravity = 0.01    # m/s^2, far below what gravity is in any unit
    if size < no_gravity:
        reasons.append(Reason(Code.NO_IMU, 'the acceleration contains no gravity: the IMU '
                              'publishes none or removes gravity, or imu.accel_scale is 0'))
        return tuple(reasons), False
    if not 0.85 * G < size < 1.15 * G:
        if 0.85 < size < 1.15:
            what = (f'the IMU measures {size:.3f} at rest, so its unit is probably g: set '
                    f'imu.accel_scale to {9.80665 * imu.accel_scale:.10g}')
        else:
            what = f'the IMU measures a gravity of {size:.3g} m/s^2 instead of 9.8 m/s^2'
        reasons.append(Reason(Code.IMU_UNITS, what))
    if fast > MAX_RATE:
        reasons.append(Reason(Code.IMU_UNITS, f'the gyro measures {fast:.3g} rad/s, more than a '
                              'vehicle can turn, so its unit is probably deg/s: set '
                              f'imu.gyro_scale to {imu.gyro_scale * RAD_PER_DEG!r}'))
    up = mean / size
    most_tilt = np.deg2rad(30.0)    # a body frame more tilted than this is not forward-left-up
    if up[2] > np.cos(most_tilt):
        return tuple(reasons), False
    axis = int(np.argmax(np.abs(up)))
    seen = f'gravity is on {"+" if up[axis] > 0 else "-"}{AXES[axis]} (up should be +z)'
    if up[2] < -np.cos(most_tilt) and np.allclose(C_bi, np.eye(3)):
        reasons.append(Reason(Code.IMU_LOOKS_Z_DOWN, f'{seen}: forward-right-down is assumed'))
        return tuple(reasons), True
    reasons.append(Reason(Code.IMU_AXES, f'{seen}: the body frame is not forward-left-up'))
    return tuple(reasons), False
