# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Priors as a part, docs/method.md (S21): of biases, constants, and where a leg begins."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from odocal_ros.calib.smoother.chain import Neighbours, Normal
from odocal_ros.calib.smoother.part import Here, hold, Part, WANTED
from odocal_ros.calib.smoother.state import (
    BA,
    BG,
    constants_from,
    GNSS_ARM,
    M,
    ODO_ARM,
    P,
    PHI,
    TYRES,
    V,
)
from odocal_ros.data.arrays import Floats

if TYPE_CHECKING:
    from odocal_ros.calib.smoother.problem import Problem

# where a leg begins, which nothing has to hold but the data: m, m/s, rad about east, north, up.
# Judgement, far wider than any data
START_SIGMAS: dict[str, tuple[slice, Floats | float]] = {
    'position': (P, 1e4), 'velocity': (V, 100.0), 'attitude': (PHI, np.array([1.0, 1.0, 10.0]))}
# priors of the vehicle, so the same in every leg
SHARED = {'odometer_lever_arm': ODO_ARM, 'antenna_lever_arm': GNSS_ARM,
          'odometer_delay': constants_from('odometer_delay'),
          'fix_latency': constants_from('gnss_delay'),
          'gyro_scale': constants_from('gyro_scale_z', 'gyro_scale_y'),
          'gyro_axes': constants_from('gyro_axis_xy', 'gyro_axis_zy'),
          'gyro_by_force': constants_from('gyro_x_by_force_x', 'gyro_z_by_force_y'),
          'accelerometer_scale': constants_from('accelerometer_scale_x', 'accelerometer_scale_z'),
          'accelerometer_axes': constants_from('accelerometer_axis_xy', 'accelerometer_axis_zy'),
          'receiver_smoothing': constants_from('fix_lag_square'),
          'tyre_changes': TYRES,
          'body_lean': constants_from('squat', 'pitch_centre'),
          'speed_truncation': constants_from('speed_offset'),
          'heading': constants_from('heading_offset')}


class PriorRows(Part):
    """Rows of the unknowns themselves, each with its prior, beside no row of a sensor."""

    name = 'priors'

    def __init__(self, problem: 'Problem', here: Here) -> None:
        self.state, self.priors = here.state, here.priors
        absent = {'heading'} - {*problem.outside}
        absent |= {'speed_truncation'} if problem.leg.travel.coarse is None else set()
        self.shared = {name: where for name, where in SHARED.items() if name not in absent}

    def _biases(self) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield columns, value and sigma of the biases at the first keyframe."""
        state, priors = self.state, self.priors
        yield BG, state.gyro_bias[0], priors.gyro_bias
        yield BA, state.accel_bias[0], priors.accel_bias

    def _constants_off(self) -> Floats:
        return self.state.constants - self.priors.centre

    def add(self, out: Normal) -> None:
        """Add the rows to normal equations; the start is held but loosely, where it is."""
        for columns, sigma in START_SIGMAS.values():
            hold(out, 0, columns, sigma**2, 0.0)
        for columns, value, sigma in self._biases():
            hold(out, 0, columns, sigma**2, value)
        w = 1 / self.priors.constants**2
        out.corner[range(M), range(M)] += w
        out.g_border -= w * self._constants_off()

    def cost(self) -> float:
        """Return the sum of squares, in sigmas."""
        total = sum((value**2 / sigma**2).sum() for _, value, sigma in self._biases())
        out: float = total + (self._constants_off()**2 / self.priors.constants**2).sum()
        return out

    def effects(self, near: Neighbours) -> Iterator[tuple[str, Floats]]:
        """Yield what the turn-on biases do."""
        first = self.with_wanted(near[0][None])[0]
        yield 'gyro_bias', first[:, BG] / self.priors.gyro_bias
        yield 'accelerometer_bias', first[:, BA] / self.priors.accel_bias

    def shared_effects(self, covariance: Floats) -> Iterator[tuple[str, Floats]]:
        """Yield what errors do that are the same in every leg: names, (3, k)."""
        for name, where in self.shared.items():
            yield name, covariance[:WANTED, where] / self.priors.constants[where]
