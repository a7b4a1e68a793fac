# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rotations: matrices, quaternions (x y z w, as in ROS) and fixed-axis roll, pitch, yaw; angles.

Heading is from north, clockwise; yaw is from east, counter-clockwise. ``q_nb`` and ``C_nb`` rotate
a vector from b to n. All functions accept (..., 3), (..., 4) or (..., 3, 3) arrays.
"""

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import Floats


def wrap(angle: ArrayLike) -> Floats:
    """Wrap an angle to (-pi, pi]; an angle in this range is returned unchanged."""
    angle = np.asarray(angle, dtype=float)
    wrapped = np.pi - (np.pi - angle) % (2 * np.pi)
    wrapped = np.where(wrapped > -np.pi, wrapped, np.pi)     # the remainder may round to 2 pi
    return np.where((angle > -np.pi) & (angle <= np.pi), angle, wrapped)[()]


def arctan2(y: ArrayLike, x: ArrayLike) -> Floats:
    """
    Return np.arctan2, independent of the memory layout of the arguments.

    numpy 1.26 (Jazzy) rounds columns of a matrix by their addresses: live and replay would differ.
    """
    return np.arctan2(np.copy(y), np.copy(x))


def yaw_from_heading(heading: float | Floats) -> Floats:
    """Convert compass heading to ENU yaw, rad."""
    return wrap(np.pi / 2 - heading)


def heading_from_yaw(yaw: ArrayLike) -> Floats:
    """Convert ENU yaw to compass heading, rad, in [0, 2 pi)."""
    heading = (np.pi / 2 - np.asarray(yaw, dtype=float)) % (2 * np.pi)
    return np.where(heading < 2 * np.pi, heading, 0.0)[()]   # the remainder may round to 2 pi


def skew(a: ArrayLike) -> Floats:
    """Return the matrix of the cross product with a: (..., 3) to (..., 3, 3)."""
    a = np.asarray(a, dtype=float)
    S = np.zeros((*a.shape, 3))
    for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        S[..., i, j] = a[..., axis]
        S[..., j, i] = -a[..., axis]
    return S


def exp_so3(phi: Floats) -> Floats:
    """Return the rotation matrix of rotation vector phi, rad: (..., 3) to (..., 3, 3)."""
    half = np.linalg.norm(phi, axis=-1)[..., None, None] / 2
    S = skew(phi)
    return np.asarray(np.eye(3) + np.sinc(2 * half / np.pi) * S
                      + np.sinc(half / np.pi) ** 2 / 2 * S @ S)


def rotvec(C: Floats) -> Floats:
    """Return the rotation vector of (..., 3, 3), rad, for angles well below pi."""
    axis = np.stack([C[..., 2, 1] - C[..., 1, 2], C[..., 0, 2] - C[..., 2, 0],
                     C[..., 1, 0] - C[..., 0, 1]], -1) / 2
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (np.trace(C, axis1=-2, axis2=-1) - 1) / 2)
    return axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)[..., None]


def transpose(C: Floats) -> Floats:
    """Return the inverse rotation: (..., 3, 3)."""
    return np.swapaxes(C, -1, -2)


def rotate(C: Floats, vectors: Floats) -> Floats:
    """Return C @ v row by row: (K, 3, 3), (K, 3)."""
    return np.asarray(np.einsum('kij,kj->ki', C, vectors))


def rotate_back(C: Floats, vectors: Floats) -> Floats:
    """Return the inverse of ``rotate``: (K, 3, 3), (K, 3)."""
    return np.asarray(np.einsum('kij,ki->kj', C, vectors))


def level_left(forward_n: Floats) -> Floats:
    """Return the level unit axes to the left of forward axes in n: (K, 3)."""
    left = np.stack([-forward_n[:, 1], forward_n[:, 0], np.zeros(len(forward_n))], -1)
    return np.asarray(left / np.linalg.norm(left, axis=1, keepdims=True))


def quat_from_rotvec(phi: ArrayLike) -> Floats:
    """Return the quaternion of rotation vector phi, rad: (..., 3) to (..., 4)."""
    phi = np.asarray(phi, dtype=float)
    half = np.sqrt(np.einsum('...i,...i->...', phi, phi)) / 2
    q = np.empty((*phi.shape[:-1], 4))
    q[..., :3] = phi * (np.sinc(half / np.pi) / 2)[..., None]
    q[..., 3] = np.cos(half)
    return q


def rotvec_from_quat(q: Floats) -> Floats:
    """Return the shortest rotation vector of a unit quaternion, rad: (..., 4) to (..., 3)."""
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1)
    small = sine < 1e-9
    size = np.where(small, 2.0, 2 * arctan2(sine, q[..., 3]) / np.where(small, 1.0, sine))
    return q[..., :3] * size[..., None]


def quat_multiply(p: ArrayLike, q: ArrayLike) -> Floats:
    """Return the product: p_ab, q_bc to q_ac, (..., 4)."""
    px, py, pz, pw = np.moveaxis(np.asarray(p, dtype=float), -1, 0)
    qx, qy, qz, qw = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    return np.stack([pw * qx + px * qw + py * qz - pz * qy,
                     pw * qy - px * qz + py * qw + pz * qx,
                     pw * qz + px * qy - py * qx + pz * qw,
                     pw * qw - px * qx - py * qy - pz * qz], axis=-1)


def quat_conjugate(q: ArrayLike) -> Floats:
    """Return the inverse of a unit quaternion: (..., 4)."""
    return np.asarray(q, dtype=float) * [-1.0, -1.0, -1.0, 1.0]


def quat_at(t_new: Floats, t: Floats, q: Floats) -> Floats:
    """Return attitudes (k, 4) at t_new, linear between rows t (m,), q (m, 4); constant outside."""
    # q and -q are the same rotation: signs that are equal in adjacent rows
    products = np.einsum('ki,ki->k', q[1:], q[:-1])
    q = q * np.cumprod(np.append(1.0, np.where(products < 0, -1.0, 1.0)))[:, None]
    out: Floats = np.stack([np.interp(t_new, t, column) for column in q.T], -1)
    out /= np.linalg.norm(out, axis=-1)[..., None]
    return out


def matrix_from_quat(q: ArrayLike) -> Floats:
    """Return the rotation matrix of a quaternion of any length but zero: (..., 4)."""
    q = np.asarray(q, dtype=float)
    x, y, z, w = np.moveaxis(q, -1, 0)
    s = 2 / np.einsum('...i,...i->...', q, q)
    C = np.empty((*q.shape[:-1], 3, 3))
    C[..., 0, 0] = 1 - s * (y * y + z * z)
    C[..., 0, 1] = s * (x * y - z * w)
    C[..., 0, 2] = s * (x * z + y * w)
    C[..., 1, 0] = s * (x * y + z * w)
    C[..., 1, 1] = 1 - s * (x * x + z * z)
    C[..., 1, 2] = s * (y * z - x * w)
    C[..., 2, 0] = s * (x * z - y * w)
    C[..., 2, 1] = s * (y * z + x * w)
    C[..., 2, 2] = 1 - s * (x * x + y * y)
    return C


def yaw_from_quat(q: Floats) -> Floats:
    """Return the yaw of b's x axis from a quaternion, rad: (..., 4) to (...)."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    s = 2 / np.einsum('...i,...i->...', q, q)
    return arctan2(s * (x * y + z * w), 1 - s * (y * y + z * z))


def quat_from_matrix(C: ArrayLike) -> Floats:
    """Return the quaternion (w >= 0) of a rotation from the largest row of 4 q q^T: (..., 4)."""
    C = np.asarray(C, dtype=float)
    xx, yy, zz = C[..., 0, 0], C[..., 1, 1], C[..., 2, 2]
    sx, sy, sz = (C[..., 2, 1] - C[..., 1, 2], C[..., 0, 2] - C[..., 2, 0],
                  C[..., 1, 0] - C[..., 0, 1])
    xy, xz, yz = C[..., 0, 1] + C[..., 1, 0], C[..., 0, 2] + C[..., 2, 0], \
        C[..., 1, 2] + C[..., 2, 1]
    rows = np.stack([np.stack([1 + xx - yy - zz, xy, xz, sx], -1),
                     np.stack([xy, 1 - xx + yy - zz, yz, sy], -1),
                     np.stack([xz, yz, 1 - xx - yy + zz, sz], -1),
                     np.stack([sx, sy, sz, 1 + xx + yy + zz], -1)], -2)
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q: Floats = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1)[..., None]
    return np.where(q[..., 3:] < 0, -q, q)


def matrix_from_rpy(rpy: ArrayLike) -> Floats:
    """Return Rz(yaw) Ry(pitch) Rx(roll) (fixed axes, URDF): (..., 3) rad to (..., 3, 3)."""
    rpy = np.asarray(rpy, dtype=float)
    (cr, cp, cy), (sr, sp, sy) = (np.moveaxis(f(rpy), -1, 0) for f in (np.cos, np.sin))
    return np.stack([np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], -1),
                     np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], -1),
                     np.stack([-sp, cp * sr, cp * cr], -1)], -2)


def rpy_from_matrix(C: ArrayLike) -> Floats:
    """Return fixed-axis roll, pitch, yaw, rad; at pitch +-90 deg roll is set to 0."""
    C = np.asarray(C, dtype=float)
    level = np.hypot(C[..., 0, 0], C[..., 1, 0])
    locked = level < 1e-12
    yaw = np.where(locked, arctan2(-C[..., 0, 1], C[..., 1, 1]),
                   arctan2(C[..., 1, 0], C[..., 0, 0]))
    # roll after rotation by -yaw: near gimbal lock its error cancels that of the yaw
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.where(locked, 0.0, arctan2(s * C[..., 0, 2] - c * C[..., 1, 2],
                                         c * C[..., 1, 1] - s * C[..., 0, 1]))
    return np.stack([roll, arctan2(-C[..., 2, 0], level), yaw], -1)
