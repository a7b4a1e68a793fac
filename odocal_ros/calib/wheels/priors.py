# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Priors of the wheels' parameters."""

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
from odocal_ros.calib.wheels.track_width import TRACK_WIDTH
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import REMARK_SIGMAS


@dataclass(frozen=True, eq=False)
class WheelPriors:
    """
    Prior sigmas of the parameters, and the steps to the priors' values.

    width : m, as configured, 0 unknown.   turn_rate : wheels' turns are used.
    latency : s.   gyro_scale : relative.
    """

    width: float
    turn_rate: bool
    latency: float
    gyro_scale: float

    def steps(self, leg: WheelLeg, state: State, width_observable: bool,
              rounds: int) -> tuple[Floats, Floats]:
        """Return inverse variances and values, (p,) each, as steps from a state."""
        weight, value = np.zeros((2, len(PARAMETERS)))
        given = self.width or TRACK_WIDTH.of_a_car
        taped = TRACK_WIDTH.taped_share * given
        loose = TRACK_WIDTH.any_sigma if width_observable else (
            TRACK_WIDTH.car_sigma if rounds > 2 else taped)
        weight[WIDTH] = 1 / (taped if self.width else loose)**2
        value[WIDTH] = given - state.width
        # without turns the fixes leave it open, and the mean of both hangs on its square: wheels
        # are alike to 1 %
        weight[RATIO] = 1.0 if self.turn_rate else 1 / 0.01**2
        value[RATIO] = -state.log_ratio
        weight[OFFSET] = 1e-6
        value[OFFSET] = -state.offset
        # s, relative: where settings ask for a sigma of 0
        weight[NUISANCES] = 1 / np.maximum(self._nuisances(state), 1e-7)**2
        value[NUISANCES] = -state.latency, -state.gyro_scale, -state.fix_lag_square
        if leg.start.surveyed:
            variance = np.diag(leg.start.covariance_n)[:2]
            weight[3:5] = 1 / np.maximum(variance, 1e-8)
            value[3:5] = leg.start.position_n[:2] - state.start_n[:2]
        return weight, value

    def nuisances(self, X: Floats, state: State) -> Floats:
        """Return the covariance that NUISANCES add to rows of derivatives, (k, k)."""
        X = X[:, NUISANCES] * self._nuisances(state)
        return X @ X.T

    def _nuisances(self, state: State) -> list[float]:
        # a receiver that smooths over a second is late by one, whatever was thought of its stamps
        late = abs(state.latency)
        latency = late if late > REMARK_SIGMAS * self.latency else self.latency
        return [latency, self.gyro_scale, 1.0]      # s^2: over a second
