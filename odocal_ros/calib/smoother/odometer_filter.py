# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The odometer's readings as the wheel turned: without their delay and the filter of a speed."""

from collections.abc import Callable

import numpy as np

from odocal_ros.calib.smoother.state import ODO_DELAY, ODO_LAG2
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.odometer import Travel

# s to each side of a time, for the acceleration at it. Judgement: with a filter of 0.4 s the
# rounding of a counter then adds a quarter of what the reading has
REACH = 0.5


def as_rolled(travel: Travel, constants: Floats) -> Callable[[Floats], Floats]:
    """
    Return the travel of the wheel as a function of time, scale units.

    A reading behind a filter is the mean of past ones with some weights. Of these count the mean
    delay D and the variance T^2, for a first-order filter the square of its time constant: the
    wheel has travelled x(t + D) - T^2 x''(t + D) / 2, but for the third moment.

    travel : of the readings.   constants : (M,), with D, s, and T^2, s^2.
    """
    delay, half = float(constants[ODO_DELAY]), float(constants[ODO_LAG2]) / 2

    def rolled(t: Floats) -> Floats:
        at = t + delay
        # at the ends that of the first and last second: beyond them there is no reading
        middle = np.clip(at, travel.t[0] + REACH, travel.t[-1] - REACH)
        before, here, after = (travel.at(middle + step) for step in (-REACH, 0.0, REACH))
        out: Floats = travel.at(at) - half * (after - 2 * here + before) / REACH**2
        return out
    return rolled
