# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
IMU signals without their noise, as derivatives by IMU errors: decision 9, noise in the regressor.

The derivative by a scale error is the signal itself. The measured signal contains noise, which
biases the estimate towards smaller signals. Once steps are below a sigma, the estimated noise is
subtracted: the residual of the axis, and the effect of gyro noise on the direction of gravity
within an interval.

A rate as small as the noise that is left is likely noise, too. A rate w of an interval counts as
w / (1 + (10 sigma / w)^2), which leaves turns, banked curves and kerbs as they are.

Sway and heave that odometer and attitude do not predict are road noise, which has levels of its
own in the fit. They are subtracted as well.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.motion import D, Motion, ROWS
from odocal_ros.nav.rotations import rotate, transpose

FORCES = 3      # definition: number of the first gyro signal that is a force
# judgement, measured in decision 9: sigmas of the noise of an interval
LIKELY_NOISE = 10.0


class Signals:
    """
    Fitted turn rates and forces of the intervals of a motion.

    sway : road noise: (K, 3) change of the sideways and vertical axle velocity in an interval, and
    its integral, in n, m/s and m.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion, state = motion, motion.state
        forward_n = state.C_nb @ state.forward
        noise = across(motion.axle.v_n, forward_n)
        moved = across(motion.residual[:, D], forward_n[:-1]) - noise[:-1] * motion.T
        self.sway = (layout.V, np.diff(noise, axis=0)), (layout.P, moved)

    def fit_rates(self, rows: slice, constants: Floats, by_bias: Floats, gyro: Floats) -> None:
        """
        Subtract the noise from the derivatives that are turn rates, in place.

        rows : slice of the intervals.   constants : (k, 18, M) derivatives, corrected in place.
        by_bias : (k, 18, 3) derivatives by the gyro bias.   gyro : (k, 18, 3 p) columns of unit
        gyro noises along the axes of n at p points.
        Derivatives by g-sensitivity stay as they are: accelerometer noise is independent of the
        gyro.
        """
        part, columns = self.motion.take(rows), constants[:, :, layout.GYRO]
        noise = rotate(transpose(part.C), part.residual[:, layout.PHI]) / part.T * part.fitted
        rate = part.sums.mean_rate + noise
        bound = (LIKELY_NOISE**2 * (gyro[:, layout.PHI]**2).sum(axis=(1, 2))[:, None] / 3
                 / part.T**2)
        noise -= rate * bound / (rate**2 + bound)
        by_bias = by_bias.copy()
        by_bias[:, layout.BG] = 0.0        # which walks, as a scale does not
        for i, (into, by) in enumerate(zip(layout.GYRO_AXIS, layout.GYRO_SIGNAL, strict=True)):
            if by < FORCES:
                columns[:, :, i] += by_bias[:, :, into] * noise[:, by, None]

    def fit_forces(self, rows: slice, constants: Floats, gyro: Floats, found: Floats) -> None:
        """Subtract noise from those that are forces; found : (k, 3 p) estimates of gyro noises."""
        part = self.motion.take(rows)
        k, C = len(part.C), part.C[:, None]
        # of the noise about each axis of b
        of_gyro = ((gyro.reshape(k, ROWS, -1, 3) @ C) * (found.reshape(k, 1, -1, 3) @ C)).sum(2)
        for axes, sway in self.sway:
            self._by_forces(part, constants[:, axes, layout.ACCEL],
                            rotate(transpose(part.C), sway[rows]), part.residual[:, axes],
                            of_gyro[:, axes])

    def _by_forces(self, part: Motion, columns: Floats, sway: Floats, residual: Floats,
                   of_gyro: Floats) -> None:
        """Correct the derivatives of velocity, or position, that are forces: columns (k, 3, a)."""
        back = transpose(part.C)
        turned = back @ of_gyro      # towards an axis of b, about an axis of b
        own = rotate(back, residual) - turned.sum(axis=2)
        for i, (into, by) in enumerate(zip(layout.ACCEL_AXIS, layout.ACCEL_SIGNAL, strict=True)):
            noise = np.zeros_like(own)
            noise[:, into] = own[:, by] - sway[:, by]
            if into == by:      # a force along one axis, turned about another, toward the third
                for about, toward in ((into - 1, into - 2), (into - 2, into - 1)):
                    noise[:, toward] += turned[:, toward, about]
            columns[:, :, i] += rotate(part.C, noise)


def across(x_n: Floats, forward_n: Floats) -> Floats:
    """Return the parts of vectors at right angles to forward: (k, 3)."""
    out: Floats = x_n - np.einsum('ki,ki->k', x_n, forward_n)[:, None] * forward_n
    return out
