# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Two frames of one IMU: its housing, and the frame that its own axes make.

Gyro and accelerometer triads are not square with the housing, so yaw and pitch mean nothing
before it is said of what. In the measurement frame only the z gyro measures a turn about z,
and the y accelerometer no acceleration along x. Driving determines these angles.
"""

import numpy as np

from odocal_ros.data.arrays import Floats


def angles(d_b: Floats) -> tuple[float, float]:
    """Return yaw and pitch mounting angle of the forward axis in b, rad."""
    d = np.asarray(d_b, dtype=float)
    return float(-np.arcsin(d[1])), float(np.arctan2(d[2], d[0]))


def turn_and_push(gyro_matrix: Floats, accel_matrix: Floats) -> Floats:
    """
    Return the rotation that takes the turn-and-push frame to that of the matrices, (3, 3).

    ``I + M`` is what the triads make of a vector. To first order it is ``I + [theta x]`` with
    theta = (M_g,yz, -M_g,xz, -M_a,yx).
    """
    gyro, accel = np.eye(3) + gyro_matrix, np.eye(3) + accel_matrix
    z = np.linalg.solve(gyro, [0.0, 0.0, 1.0])
    z /= np.linalg.norm(z)
    x = np.cross(accel[1], z)      # not measured by the y accelerometer, perpendicular to z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], -1)


def own_angles(C_vb: Floats, C_bi: Floats, gyro_matrix: Floats,
               accel_matrix: Floats) -> tuple[float, float, float, float]:
    """Return yaw and pitch by the IMU's own axes, then by its housing, rad; matrices in i."""
    d = np.asarray(C_vb)[0]
    R = turn_and_push(C_bi @ gyro_matrix @ C_bi.T, C_bi @ accel_matrix @ C_bi.T)
    return *angles(R.T @ d), *angles(d)
