# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What is believed of the wheels' parameters before the drive speaks."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import (
    NUISANCES,
    OFFSET,
    PARAMETERS,
    RATIO,
    State,
    WIDTH,
)
from odocal_ros.calib.wheels.noise import ANY_WIDTH

EQUAL_RATIO = 0.01         # of wheels whose ratio nothing tells
ANY_TRACK_WIDTH = 10.0     # m, sigma of a track width of which nothing is known
CAR_WIDTH_SIGMA = 0.8      # m, sigma of that of a car
WIDTH_SIGMA = 0.02         # of a track width given: taped, and tyres are wide
FIRM_SIGMA = 1e-7          # s, relative: the least sigma of latency and gyro scale, 0 asked for
LAG2_SIGMA = 1.0           # s^2, sigma of fix_lag_square
LATENCY_GIVES_WAY = 3.0    # sigmas of a latency found from which its prior gives way


@dataclass(frozen=True, eq=False)
class WheelPriors:
    """
    Sigmas known beforehand.

    width : m, as configured, 0 unknown.   turn_rate : wheels' turns are used.
    latency : s.   gyro_scale : relative.
    """

    width: float
    turn_rate: bool
    latency: float
    gyro_scale: float

    def steps(self, leg: WheelLeg, state: State, told, rounds):
        """Return inverse variances and values, (p,) each, as steps from a state."""
        weight, value = np.zeros((2, len(PARAMETERS)))
        given = self.width or ANY_WIDTH
        loose = ANY_TRACK_WIDTH if told else CAR_WIDTH_SIGMA if rounds > 2 else WIDTH_SIGMA * given
        weight[WIDTH] = 1 / (WIDTH_SIGMA * given if self.width else loose)**2
        value[WIDTH] = given - state.width
        # without turns the fixes leave it open, and the mean of both hangs on its square
        weight[RATIO] = 1.0 if self.turn_rate else 1 / EQUAL_RATIO**2
        value[RATIO] = -state.log_ratio
        weight[OFFSET] = 1e-6
        value[OFFSET] = -state.offset
        weight[NUISANCES] = 1 / np.maximum(self._nuisances(state), FIRM_SIGMA)**2
        value[NUISANCES] = -state.latency, -state.gyro_scale, -state.fix_lag_square
        if leg.start.surveyed:
            variance = np.diag(leg.start.covariance_n)[:2]
            weight[3:5] = 1 / np.maximum(variance, 1e-8)
            value[3:5] = leg.start.position_n[:2] - state.start_n[:2]
        return weight, value

    def nuisances(self, X, state):
        """Return the covariance that NUISANCES add to rows of derivatives, (k, k)."""
        X = X[:, NUISANCES] * self._nuisances(state)
        return X @ X.T

    def _nuisances(self, state):
        # a receiver that smooths over a second is late by one, whatever was thought of its stamps
        late = abs(state.latency)
        latency = late if late > LATENCY_GIVES_WAY * self.latency else self.latency
        return [latency, self.gyro_scale, LAG2_SIGMA]
