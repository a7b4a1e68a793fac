# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Displacement of the odometer due to the tilt of the body, delta D of docs/method.md (S12).

The IMU measures the tilt of the body. On hills and banks the body tilts with the ground, about
points at the height of the wheels on the ground. On bumps and under forces it tilts on its
springs, about a centre above the ground. ``separate_tilts`` separates both.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.axle import Axle
from odocal_ros.estimator.state import State
from odocal_ros.nav.rotations import level_left, rotate
from odocal_ros.settings.nominal import G


class BodyTilt:
    """
    The tilt of the body in the K intervals between N keyframes.

    rate_n : (K, 3) rad/s, mean turn rates.   level_left : (K, 3) level axes to the left, at start.
    pitch_increments : (K, 4) rad, nose down: about ``level_left``; that of the body alone; by
        turns on banked ground; and the turn about up.
    displacements : (K, 3, 6) m in n, of the odometer by a unit of each of BODY_TILT.
    """

    def __init__(self, state: State, mean_rate: Floats, axle: Axle) -> None:
        """mean_rate : (K, 3) rad/s in b."""
        T, C = np.diff(state.t), state.C_nb[:-1]
        _, left, up = state.C_bv_level.T
        self.rate_n, self.level_left = rotate(C, mean_rate), level_left(C @ state.forward)
        body_pitch = axle.body_pitch()
        about_level = np.einsum('ki,ki->k', self.rate_n, self.level_left) * T
        # about the left axis of the vehicle, which differs on banked ground. Without the mean
        # roll, in which the equations are not linear: the turn about up corrects its effect
        about_left = np.einsum('ki,ki->k', self.rate_n, C @ left) * T
        self.pitch_increments = np.stack(
            [about_level, -np.diff(body_pitch), about_left - about_level,
             mean_rate @ up * T], -1)
        # nose down about a point ahead, the odometer goes up
        lifts = (C @ up)[:, :, None] * self.pitch_increments[:, None]
        self.displacements = np.concatenate(
            [lifts[:, :, :3], _horizontal(state, axle, body_pitch), lifts[:, :, 3:]], axis=2)


def _horizontal(state: State, axle: Axle, body_pitch: Floats) -> Floats:
    """Return displacements per height of the centre of the body, and per force: (K, 3, 2)."""
    left_n = level_left(state.C_nb @ state.forward)
    ahead_n = np.cross(left_n, [0.0, 0.0, 1.0])
    bank, roll = axle.rolls()
    force = axle.left_acceleration + G * bank
    return np.diff(np.stack([body_pitch[:, None] * ahead_n + roll[:, None] * left_n,
                             force[:, None] * left_n], -1), axis=0)
