# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The odometer of a leg against the IMU's acceleration: slips that no other check has named."""

import numpy as np

from odocal_ros.calib.slip import find_slips, rounding, Slips, SPIN_WINDOW
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.pipeline.prepared import PreparedLeg


def slip_check(ready: PreparedLeg, track: Track, f: Floats,
               between: tuple[float, float]) -> Slips:
    """
    Return the slips of the mean of the wheels, without those of one wheel, which are named.

    ready : PreparedLeg.   track : Track, of a method.   f : (3,) scale times forward axis.
    between : s.
    """
    if not ready.inputs.felt:
        return Slips(np.empty(0), np.empty(0))
    slips = find_slips(ready.inputs.t_imu, ready.inputs.f_b, track, f, ready.origin.latitude,
                       rounding(ready.inputs.travel))
    known = (np.abs(slips.t[:, None] - ready.wheel_slips.t) < SPIN_WINDOW).any(axis=1)
    held = (slips.t >= between[0]) & (slips.t <= between[1]) & ~known
    return slips._replace(t=slips.t[held], size=slips.size[held])
