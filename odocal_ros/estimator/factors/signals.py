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
    Fitted turn rates and forces of the intervals of a motion.

    sway : road noise in n, for the rows of velocity and of position: (K, 3) change of the sideways
    and vertical velocity of the axle in an interval, m/s, and its integral, m.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion, state = motion, motion.state
        forward_n = state.C_nb @ state.forward
        velocity = perpendicular(motion.axle.v_n, forward_n)
        path = perpendicular(motion.residual[:, D], forward_n[:-1]) - velocity[:-1] * motion.T
        self.sway = (layout.V, np.diff(velocity, axis=0)), (layout.P, path)

    def fit_rates(self, rows: slice, constants: Floats, by_bias: Floats, gyro: Floats) -> None:
        """
        Subtract the noise from derivatives by gyro errors that multiply a turn rate, in place.

        rows : slice of the intervals.   constants : (k, 18, M) derivatives.   by_bias : (k, 18, 3)
        derivatives by the gyro bias.   gyro : (k, 18, 3 p) effects of unit gyro noises about the
        axes of n at p times. Derivatives by g-sensitivity are not changed: accelerometer noise is
        independent of the gyro.
        """
        part, columns = self.motion.take(rows), constants[:, :, layout.GYRO]
        noise = rotate(transpose(part.C), part.residual[:, layout.PHI]) / part.T * part.fitted
        rate = part.sums.mean_rate + noise
        bound = (LIKELY_NOISE**2 * (gyro[:, layout.PHI]**2).sum(axis=(1, 2))[:, None] / 3
                 / part.T**2)
        noise -= rate * bound / (rate**2 + bound)
        by_bias = by_bias.copy()
        by_bias[:, layout.BG] = 0.0     # the rows of the bias walk do not depend on scale errors
        for i, (axis, signal) in enumerate(layout.GYRO_ERRORS.values()):
            if signal < FORCES:
                columns[:, :, i] += by_bias[:, :, axis] * noise[:, signal, None]

    def fit_forces(self, rows: slice, constants: Floats, gyro: Floats, estimates: Floats) -> None:
        """Subtract the noise from the others; estimates : (k, 3 p) of the unit gyro noises."""
        part = self.motion.take(rows)
        k, C = len(part.C), part.C[:, None]
        # effects on the rows of the estimated noise about each axis of b
        by_gyro = ((gyro.reshape(k, ROWS, -1, 3) @ C)
                   * (estimates.reshape(k, 1, -1, 3) @ C)).sum(2)
        for axes, sway in self.sway:
            self._by_forces(part, constants[:, axes, layout.ACCEL],
                            rotate(transpose(part.C), sway[rows]), part.residual[:, axes],
                            by_gyro[:, axes])

    def _by_forces(self, part: Motion, columns: Floats, sway: Floats, residual: Floats,
                   by_gyro: Floats) -> None:
        """Correct the derivatives of velocity or position by ACCEL: columns (k, 3, a)."""
        to_b = transpose(part.C)
        by_gyro = to_b @ by_gyro      # (k, 3, 3) along an axis of b, by noise about an axis of b
        by_accel = rotate(to_b, residual) - by_gyro.sum(axis=2)
        for i, (axis, signal) in enumerate(layout.ACCEL_ERRORS.values()):
            noise = np.zeros_like(by_accel)
            noise[:, axis] = by_accel[:, signal] - sway[:, signal]
            if axis == signal:  # a force along one axis, turned about another, towards the third
                for about, toward in ((axis - 1, axis - 2), (axis - 2, axis - 1)):
                    noise[:, toward] += by_gyro[:, toward, about]
            columns[:, :, i] += rotate(part.C, noise)


def perpendicular(x_n: Floats, forward_n: Floats) -> Floats:
    """Return the components of vectors perpendicular to forward: (k, 3)."""
    out: Floats = x_n - np.einsum('ki,ki->k', x_n, forward_n)[:, None] * forward_n
    return out
