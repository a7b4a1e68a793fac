# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Solution of the wheels' least squares: the state, and how the observations make it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheels.height import Height
from odocal_ros.calib.wheels.judge_noise import FixNoise, TurnNoise
from odocal_ros.calib.wheels.least_squares import Fit
from odocal_ros.calib.wheels.model import Bins, Equations, NUISANCES, State
from odocal_ros.calib.wheels.noise import Part
from odocal_ros.data.arrays import Floats


@dataclass(frozen=True, eq=False)
class Solution:
    """
    The estimate: state, and how the observations make it.

    residual : (3N,) m, what is taken for errors of the fixes.   X : (3N, p).
    priors : (p,) inverse prior variances.   parts : of the covariance.
    kept, dropped : fixes.   bias_z : value, sigma of the gyro's bias about the vertical, rad/s,
    against that of the alignment.   width_observable : the drive turns enough for the track width.
    """

    state: State
    bins: Bins
    eq: Equations
    fit: Fit
    residual: NDArray[np.float64]
    X: NDArray[np.float64]
    priors: NDArray[np.float64]
    parts: tuple[Part, ...]
    height: Height
    noise: FixNoise
    turns: TurnNoise
    kept: int
    dropped: int
    bias_z: tuple[float, float]
    width_observable: bool
    settled: bool

    def covariance(self) -> Floats:
        """Return the covariance of the observations, with that of the nuisances' priors."""
        X = self.X[:, NUISANCES]
        return sum(p.whole() for p in self.parts) + X / self.priors[NUISANCES] @ X.T
