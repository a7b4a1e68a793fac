# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of a change of the accelerometer's unit or range during the leg, by gravity."""

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.pieces import medians
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.grades import G

TENTHS, TENTH_ROWS = 10, 20       # judgement: of a leg; rows of one
# judgement: limits of measured gravity over the Earth's. Units and ranges differ by a factor of 2
# at least; in a continuous bend at 1.2 g the force is 1.56 times gravity
LEAST_RATIO, MOST_RATIO = 0.6, 1.6


def tenths(inputs: Inputs) -> NDArray[np.intp]:
    """Return the edges of the tenths of the accelerometer's rows, (11,); (0,) without enough."""
    edges = np.linspace(0, len(inputs.t_imu), TENTHS + 1).astype(int)
    return edges if inputs.has_accelerometer and edges[1] >= TENTH_ROWS else edges[:0]


def unit_changes(inputs: Inputs) -> tuple[Reason, ...]:
    """
    Return IMU_UNITS if gravity in a tenth of the leg differs from the Earth's.

    The median force over a tenth of a leg differs less from gravity by accelerations.
    """
    edges = tenths(inputs)
    size = [float(np.linalg.norm(medians(inputs.f_b[a:b])))
            for a, b in zip(edges[:-1], edges[1:], strict=True)]
    odd = [k for k, one in enumerate(size) if not LEAST_RATIO * G < one < MOST_RATIO * G]
    if not odd or len(odd) == len(size):      # all tenths: the unit of the whole leg
        return ()
    begin, end = inputs.t_imu[edges[odd[0]]], inputs.t_imu[edges[odd[-1] + 1] - 1]
    return (Reason(Code.IMU_UNITS, f'from t = {begin:.0f} to {end:.0f} s the IMU measures a '
                   f'gravity of {size[odd[0]]:.3g} m/s^2 instead of 9.8 m/s^2', 'Check the IMU '
                   'driver for a change of unit or range during the drive, or mark a leg on one '
                   'side of it with --leg.'),)
