# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The estimator of the wheels: generalised least squares over all bins, relinearised until it rests.

All that errs is in one covariance V of the observations, so the sigma is that of the estimate,
whole, and falls apart into the shares of the parts: it is B V B^T with
B = (X^T V^-1 X)^-1 X^T V^-1.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.wheels.first import first_state, near_neighbours, thinned
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import make_bins
from odocal_ros.calib.wheels.rounds import Rounds
from odocal_ros.calib.wheels.solution import Solution
from odocal_ros.calib.wheels.track_width import TRACK_WIDTH
from odocal_ros.settings.config import Config


def solve(leg: WheelLeg, config: Config, turn_rate: bool = True,
          n_bins: int = 100) -> Solution | None:
    """
    Estimate scale, ratio, heading and track width of a leg.

    turn_rate : False leaves the wheels' turn against the gyro's out.   n_bins : at most, of 1 s at
    least; twice 100 move no sigma by more than 2 %.

    Returns
    -------
    Solution, None where the fixes are too few.

    """
    variance = np.trace(leg.covariance_n[:, :2, :2], axis1=1, axis2=2) / 2
    t0 = max(leg.t_start, float(leg.left.t[0]))
    t1 = min(leg.t_stop, float(leg.left.t[-1]))
    late = 2 * config.gnss.time_sigma       # nearer to the track's ends a fix may lie off it
    inside = ((leg.t_fix >= max(t0, leg.left.t[0] + late))
              & (leg.t_fix <= min(t1, leg.left.t[-1] - late))
              & np.isfinite(leg.fixes_n[:, :2]).all(axis=1))
    if inside.sum() < 5 or t1 - t0 < 5.0:
        return None
    leg = thinned(leg)
    state, residual = first_state(leg, inside, variance)
    keep = inside.copy()
    keep[inside] = near_neighbours(residual, np.sqrt(variance[inside]))
    n = int(np.clip(min(n_bins, t1 - t0, keep.sum() / 2), 4, None))
    bins = make_bins(leg.t_fix, keep, variance, t0, t1, n)
    width = config.odometer.track_width
    state = replace(state, width=width or TRACK_WIDTH.of_a_car, phi=np.zeros((n + 1, 3)))
    return Rounds(leg, config, bins, turn_rate, width).run(state, int(inside.sum()))
