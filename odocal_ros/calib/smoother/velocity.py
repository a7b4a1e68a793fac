# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A velocity from outside, docs/method.md (S18): the GNSS antenna's, when it was true."""

from typing import TYPE_CHECKING

import numpy as np

from odocal_ros.calib.smoother.least import LEAST
from odocal_ros.calib.smoother.motion import gravity_n
from odocal_ros.calib.smoother.outside import Velocity
from odocal_ros.calib.smoother.outside_rows import OutsideRows, Rows
from odocal_ros.calib.smoother.part import Here
from odocal_ros.calib.smoother.preintegrate import Points, turn
from odocal_ros.calib.smoother.state import (
    ACCEL,
    BA,
    BARE,
    BG,
    GNSS_ARM,
    GNSS_DELAY,
    GYRO_SCALE,
    M,
    PHI,
    PITCH,
    State,
    V,
    YAW,
)
from odocal_ros.nav.rotations import skew

if TYPE_CHECKING:
    from odocal_ros.calib.smoother.problem import Problem


class VelocityRows(OutsideRows):
    """Residuals of a velocity (sent less predicted) and their derivatives at one state."""

    name, source = 'velocity', 'fix_velocity'
    levels_of = {'velocity': slice(0, 2), 'velocity_up': slice(2, 3)}

    def rows(self, problem: 'Problem', here: Here) -> Rows:
        """Return the rows."""
        return _velocity(problem, here.state, here.points['velocity'], here.fix_later)

    @staticmethod
    def least(sent: Velocity) -> dict[str, float]:
        """Return the least levels."""
        sigma = np.median(sent.sigma, axis=0)
        return {'velocity': (LEAST.velocity / sigma[0])**2,
                'velocity_up': (LEAST.velocity / sigma[2])**2}


def _velocity(problem: 'Problem', state: State, points: Points, later: float) -> Rows:
    leg, sent, k = problem.leg, problem.outside['velocity'], points.interval
    assert isinstance(sent, Velocity)
    C, tau = state.C_nb[k], points.tau[:, None]
    C_t = C @ points.R
    arm_v = leg.antenna_arm - leg.imu_arm + state.constants[GNSS_ARM]
    arm_b = state.C_bv @ arm_v
    dv, g = turn(C, points.dv), gravity_n(state.p_n[k], leg.origin)
    swing = turn(C_t, np.cross(points.rate, arm_b))
    faster = turn(C, points.force) + g
    raw = sent.velocity_n - (state.v_n[k] + dv + g * tau + swing) + faster * later
    m, t = len(k), tau[:, :, None]
    J, c = np.zeros((m, 3, BARE)), np.zeros((m, 3, M))
    J[:, :, V] = -np.eye(3)
    J[:, :, PHI] = skew(dv + swing)
    J[:, :, BA] = C * t
    # a turn rate less by the bias: half the turn acts on what force did, all of it on the arm
    J[:, :, BG] = -(skew(dv) / 2 + skew(swing)) @ C * t - C_t @ skew(arm_b)
    by_yaw, by_pitch = state.C_bv_gradient()
    W = C_t @ skew(points.rate)
    c[:, :, YAW], c[:, :, PITCH] = (-W @ (x @ arm_v) for x in (by_yaw, by_pitch))
    c[:, :, GNSS_ARM] = -W @ state.C_bv
    c[:, :, GNSS_DELAY] = faster
    c[:, :, GYRO_SCALE] = J[:, :, BG.start + 2] * points.rate[:, 2:]
    c[:, :, ACCEL] = C @ points.F
    return Rows(k, raw, J, c, np.asarray(1 / sent.sigma))
