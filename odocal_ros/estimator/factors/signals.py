# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
IMU signals without their noise, for the derivatives by IMU errors (docs/decisions/0009).

The derivative by a scale error of the IMU is the signal itself. The measured signal contains
noise, which biases the estimate towards smaller signals (noise in the regressor). Once steps of
the fit are below a sigma, the estimated noise is subtracted: the residual of the axis, and the
effect of gyro noise on the direction of gravity within an interval.

A turn rate that is as small as the remaining noise is likely noise, too. A rate w of an interval
counts as w / (1 + (10 sigma / w)^2), which hardly changes turns, banked curves and kerbs.

Sway and heave that odometer and attitude do not predict are road noise, which has levels of its
own in the fit. They are subtracted as well.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.motion import D, Motion, ROWS
from odocal_ros.nav.rotations import rotate, transpose

FORCES = 3      # definition: index of the first of GYRO_SIGNAL that is a force
# judgement, measured in decision 9: sigmas of the noise of an interval
LIKELY_NOISE = 10.0


class Signals:
    """
    Corrections of the derivatives by IMU errors, for the fitted signals of a motion.

    road_velocity, road_position : road noise, the change of the sideways and vertical velocity of
    the axle in an interval, and its integral: (K, 3) m/s, (K, 3) m, in n.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion, state = motion, motion.state
        forward_n = state.C_nb @ state.forward
        velocity = _perpendicular(motion.axle.v_n, forward_n)
        path = _perpendicular(motion.residual[:, D], forward_n[:-1])
        self.road_velocity = np.diff(velocity, axis=0)
        self.road_position = path - velocity[:-1] * motion.T

    def gyro_corrections(self, rows: slice, by_bias: Floats, gyro: Floats) -> Floats:
        """
        Return the corrections of the derivatives by GYRO for fitted turn rates: (k, 18, g).

        by_bias : (k, 18, 3) derivatives by the gyro bias.   gyro : (k, 18, 3 p) effects of unit
        gyro noises about the axes of n at p times. Derivatives by g-sensitivity are not changed:
        accelerometer noise is independent of the gyro.
        """
        part = self.motion.take(rows)
        noise = rotate(transpose(part.C), part.residual[:, layout.PHI]) / part.T * part.fitted
        rate = part.sums.mean_rate + noise
        # (rad/s)^2, limit for a rate that is likely noise
        limit = (LIKELY_NOISE**2 * (gyro[:, layout.PHI]**2).sum(axis=(1, 2))[:, None] / 3
                 / part.T**2)
        noise -= rate * limit / (rate**2 + limit)
        by_bias = by_bias.copy()
        by_bias[:, layout.BG] = 0.0     # the rows of the bias walk do not depend on scale errors
        out = np.zeros((*by_bias.shape[:2], len(layout.GYRO_ERRORS)))
        for i, (axis, signal) in enumerate(layout.GYRO_ERRORS.values()):
            if signal < FORCES:
                out[:, :, i] = by_bias[:, :, axis] * noise[:, signal, None]
        return out

    def accel_corrections(self, rows: slice, gyro: Floats,
                          estimates: Floats) -> tuple[Floats, Floats]:
        """
        Return the corrections of the derivatives of velocity and position by ACCEL.

        gyro : as above.   estimates : (k, 3 p) of these unit noises. The result is (k, 3, a) each.
        """
        part = self.motion.take(rows)
        k, C = len(part.C), part.C[:, None]      # number of intervals, attitudes
        # effects on the rows of the estimated noise about each axis of b
        by_gyro = ((gyro.reshape(k, ROWS, -1, 3) @ C)
                   * (estimates.reshape(k, 1, -1, 3) @ C)).sum(2)
        return (self._by_forces(part, self.road_velocity[rows], layout.V, by_gyro),
                self._by_forces(part, self.road_position[rows], layout.P, by_gyro))

    def _by_forces(self, part: Motion, road: Floats, columns: slice, by_gyro: Floats) -> Floats:
        """Return the corrections of velocity or position, (k, 3, a); columns : V or P."""
        to_b = transpose(part.C)
        road_b, residual_b = rotate(to_b, road), rotate(to_b, part.residual[:, columns])
        by_gyro = to_b @ by_gyro[:, columns]     # along an axis of b, by noise about an axis of b
        by_accel = residual_b - by_gyro.sum(axis=2)
        out = np.empty((*road.shape, len(layout.ACCEL_ERRORS)))
        for i, (axis, signal) in enumerate(layout.ACCEL_ERRORS.values()):
            noise = np.zeros_like(by_accel)
            noise[:, axis] = by_accel[:, signal] - road_b[:, signal]
            if axis == signal:  # a force along one axis, turned about another, towards the third
                for about, toward in ((axis - 1, axis - 2), (axis - 2, axis - 1)):
                    noise[:, toward] += by_gyro[:, toward, about]
            out[:, :, i] = rotate(part.C, noise)
        return out


def _perpendicular(x_n: Floats, forward_n: Floats) -> Floats:
    """Return the components of vectors perpendicular to forward: (k, 3)."""
    out: Floats = x_n - np.einsum('ki,ki->k', x_n, forward_n)[:, None] * forward_n
    return out
