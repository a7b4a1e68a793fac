# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The travel of the wheel, from readings with a delay and a low-pass filtered speed."""

from collections.abc import Callable

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.state import ODO_CLOCK, ODO_DELAY, ODO_LAG2
from odocal_ros.nav.odometer import Travel

# s to each side of a time, for the derivatives at it. Judgement: with a filter of 0.4 s, the
# rounding error of a counter adds twice the error of a reading
REACH = 0.5
# definition: differences over it
STENCIL = REACH * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
BY_SQUARE = np.array([1.0, 0.0, -2.0, 0.0, 1.0]) / REACH**2
BY_CUBE = np.array([-1.0, 2.0, 0.0, -2.0, 1.0]) * 4 / REACH**3


def stamp_of(t: Floats, constants: Floats) -> Floats:
    """Return the stamps, s, of readings of the wheel at some times; the delay is that at 0."""
    out: Floats = t + constants[ODO_DELAY] + constants[ODO_CLOCK] * t
    return out


def as_rolled(travel: Travel, constants: Floats) -> Callable[[Floats], Floats]:
    """
    Return the travel of the wheel as a function of time, scale units.

    A filtered reading is a weighted mean of past ones. Its weights have a mean delay D and a
    variance T^2, which is the square of the time constant for a first-order filter. The travel of
    the wheel is x(t + D) - T^2 x''(t + D) / 2 + T^3 x'''(t + D) / 3, with the third moment of such
    a filter.

    travel : of the readings.   constants : (M,), with D, s, and T^2, s^2.
    """
    square = float(constants[ODO_LAG2])
    weights = -square / 2 * BY_SQUARE + max(square, 0.0)**1.5 / 3 * BY_CUBE

    def rolled(t: Floats) -> Floats:
        at = stamp_of(t, constants)
        # at the ends the derivative of the first and last second: there are no readings beyond
        middle = np.clip(at, travel.t[0] + REACH, travel.t[-1] - REACH)
        out: Floats = travel.at(at) + sum(
            weight * travel.at(middle + step)
            for weight, step in zip(weights.tolist(), STENCIL.tolist(), strict=True))
        return out
    return rolled
