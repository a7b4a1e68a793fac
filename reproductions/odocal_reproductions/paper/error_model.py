# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Error model of dead reckoning: the end point error by attitude errors and gyro drift.

Shi et al. 2015, eq. (15)-(23), corrected, as a linear time-varying system along a leg

    x' = F(t) x - [C_nb; 0] eps_b        x = [phi_E, phi_N, phi_U, dL, dlam, dh]

phi (rad) and the position errors (rad, rad, m) are estimate minus truth: computed attitude =
(I - [phi x]) true attitude, the computed one relative to the local level at the computed position,
the true one relative to that at the true position. eps_b (rad/s) is the error of the gyro.

With a ``radius``, the Earth is the sphere of the paper, without vertical speed and effects of
height; the first five states are eq. (15)-(23) and dh is the third row of (21). With
``radius=None`` it is WGS 84 with height and vertical speed, the exact linearisation of
``nav/strapdown.py`` and ``nav/dead_reckoning.py``.

These two use axes n that are fixed to the Earth at the start of the leg, without transport rate.
With psi the attitude error and dr the position error in n, and l the local level at the true
position,

    phi = C_ln psi + dtheta,    dtheta = [-dL, dlam cos L, dlam sin L]
    C_ln dr = [(N + h) cos L dlam, (M + h) dL, dh]

dtheta is the rotation from the local level at the true to that at the computed position. In n,
psi' = psi x omega_ie - C_nb eps_b and dr' = v x psi: psi changes by the Earth rate and drift only.
"""

import numpy as np

from odocal_reproductions.paper.path import Path
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.geodesy import E2, OMEGA, radii

STATES = ('phi_E', 'phi_N', 'phi_U', 'dL', 'dlam', 'dh')
E, N, U, LAT, LON, H = range(6)    # definition: indices of the states
PAPER_RADIUS = 6378137.0    # m, physical: R_e of Shi et al. 2015


def coefficients(latitude: Floats | float, height: Floats | float,
                 velocity_n: Floats | tuple[float, float, float],
                 radius: float | None = None) -> Floats:
    """
    Return F, the rates of the states by the states: (...), (...), (..., 3) to (..., 6, 6).

    Rows and columns in the order of STATES; rad, m, s. ``radius``: see the module.
    """
    latitude, height = np.asarray(latitude, float), np.asarray(height, float)
    vE, vN, vU = np.moveaxis(np.asarray(velocity_n, dtype=float), -1, 0)
    s, c = np.sin(latitude), np.cos(latitude)
    tan, sec = s / c, 1 / c
    if radius is None:
        meridian, normal = radii(latitude)
        RM, RN = meridian + height, normal + height
        dlnRN = E2 * s * c / (1 - E2 * s * s)      # d ln RN / dL; d ln RM / dL is 3 times as large
        dRM, dRN, by_height = 3 * dlnRN * meridian, dlnRN * normal, 1.0
    else:
        RM = RN = np.asarray(radius, float)
        dRM, dRN, by_height = 0.0 * RM, 0.0 * RN, 0.0
        vU = np.zeros_like(vU)
    F = np.zeros((*np.broadcast(latitude, vE).shape, 6, 6))
    # phi x omega_in of the attitude rows
    wE, wN, wU = -vN / RM, OMEGA * c + vE / RN, OMEGA * s + vE * tan / RN
    F[..., E, N], F[..., E, U] = wU, -wN
    F[..., N, E], F[..., N, U] = -wU, wE
    F[..., U, E], F[..., U, N] = wN, -wE
    F[..., :3] += _velocity_error_effects((vE, vN, vU), RM, RN, tan, sec)
    # a position error changes the computed Earth rate and radii
    north_L, north_h = -vN / RM**2 * dRM, -vN / RM**2 * by_height
    east_L, east_h = -vE / RN**2 * dRN, -vE / RN**2 * by_height
    F[..., E, LAT], F[..., E, H] = -north_L, -north_h
    F[..., N, LAT], F[..., N, H] = -OMEGA * s + east_L, east_h
    F[..., U, LAT] = OMEGA * c + vE * sec**2 / RN + tan * east_L
    F[..., U, H] = tan * east_h
    F[..., LAT, LAT], F[..., LAT, H] = north_L, north_h
    F[..., LON, LAT] = vE * sec * tan / RN + sec * east_L
    F[..., LON, H] = sec * east_h
    return F


def _velocity_error_effects(velocity_n: tuple[Floats, Floats, Floats], RM: Floats, RN: Floats,
                            tan: Floats, sec: Floats) -> Floats:
    """
    Return the rates of the states by phi through the velocity error v x phi of (21): (..., 6, 3).

    velocity_n : east, north, up, m/s, (...) each.   RM, RN : radii of curvature, m.   tan, sec :
    of the latitude.
    """
    vE, vN, vU = np.broadcast_arrays(*velocity_n, tan)[:3]
    zero = np.zeros_like(vE)
    dv_E, dv_N, dv_U = (np.stack(row, -1) for row in (
        (zero, -vU, vN), (vU, zero, -vE), (-vN, vE, zero)))
    by_north, by_east = dv_N / RM[..., None], dv_E / RN[..., None]
    return np.stack([-by_north, by_east, by_east * tan[..., None],      # in omega_in
                     by_north, by_east * sec[..., None], dv_U], -2)     # (18), (22); (19), (23)


def propagate(path: Path, x_0: Floats | list[float], eps_b: Floats | list[float],
              radius: float | None = None) -> Floats:
    """
    Return the states at every epoch, (m, 6).

    x_0 : (6,) states at the first epoch.   eps_b : (3,) or (m - 1, 3) gyro drift in b, rad/s,
    constant or mean of each interval.   radius : see the module.
    """
    transitions = _from_first_epoch(
        _transitions(path, radius, np.asarray(eps_b, dtype=float)[..., None]))
    x: Floats = transitions[..., :6] @ np.asarray(x_0, dtype=float) + transitions[..., 6]
    return x


def _transitions(path: Path, radius: float | None, drift_b: Floats) -> Floats:
    """Return [A | B] to each epoch, x_1 = A x_0 + B: (m, 6, 7).   drift_b : (..., 3, 1) in b."""
    dt = np.diff(path.t)[:, None, None]
    latitude, height = ((a[:-1] + a[1:]) / 2 for a in (path.latitude, path.height))
    Fdt = coefficients(latitude, height, path.velocity_n, radius) * dt
    drift_angle = (path.C_nb[:-1] + path.C_nb[1:]) * (dt / 2) @ drift_b
    # exp(F dt) to second order: rates are of 1e-4 /s, the next term is 1e-13 in a second
    A = Fdt + Fdt @ Fdt / 2
    A[:, range(6), range(6)] += 1.0
    # the drift of an interval acts for half of it on average
    B = Fdt[..., :3] @ drift_angle / -2
    B[:, :3] -= drift_angle
    return np.concatenate([np.eye(6, 7)[None], np.concatenate([A, B], axis=-1)])


def _from_first_epoch(transitions: Floats) -> Floats:
    """
    Return the transitions from the first epoch, from those between adjacent epochs: (n, 6, 7).

    A parallel scan: blocks of transitions are composed side by side, then the blocks by recursion.
    """
    composed = transitions.copy()
    max_width = 64    # transitions of a block
    width = min(max_width, max(2, int(np.sqrt(len(composed)))))
    for k in range(1, min(width, len(composed))):
        step = composed[k::width]
        step[:] = _product(step, composed[k - 1::width][:len(step)])
    ends = composed[width - 1::width].copy()
    if len(ends) > 1:
        ends = _from_first_epoch(ends)
    for k in range(width):
        step = composed[width + k::width]
        step[:] = _product(step, ends[:len(step)])
    return composed


def _product(second: Floats, first: Floats) -> Floats:
    """Return the transition of first and then second: A2 A1 x + (A2 B1 + B2)."""
    product = second[..., :6] @ first
    product[..., 6:] += second[..., 6:]
    return product
