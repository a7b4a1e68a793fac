# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Error model of dead reckoning: how attitude errors and gyro drift become a wrong end point.

Shi et al. 2015, eq. (15)-(23), corrected, as a linear time-varying system along a leg

    x' = F(t) x - [C_nb; 0] eps_b        x = [phi_E, phi_N, phi_U, dL, dlam, dh]

phi (rad) and the position errors (rad, rad, m) are estimate less truth: computed attitude =
(I - [phi x]) true attitude, the computed one against the local level at the *computed* position,
the true one against that at the true position. eps_b (rad/s) is what the gyro reads too much.

Two Earths. ``radius`` given: the sphere of the paper, no vertical speed, height not fed back;
the first five states are eq. (15)-(23) and dh is the third row of (21). ``radius=None``: WGS 84
with height and vertical speed, the exact linearisation of what ``strapdown`` and
``dead_reckoning`` do.

Those two work in axes n that are fixed to the Earth where the leg begins, and know no transport
rate. With psi the attitude error there and dr the position error, both in n,

    phi = C_ln psi + dtheta,    dtheta = [-dL, dlam cos L, dlam sin L]
    C_ln dr = [(N + h) cos L dlam, (M + h) dL, dh]

l being the local level at the true position: dtheta is the turn of the local level between the
true and the computed position. There psi' = psi x omega_ie - C_nb eps_b and dr' = v x psi, so a
heading error psi is constant but for the Earth's turn; phi has the rest.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_reproductions.paper.path import Path
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.geodesy import E2, OMEGA, radii

STATES = ('phi_E', 'phi_N', 'phi_U', 'dL', 'dlam', 'dh')
E, N, U, LAT, LON, H = range(6)    # definition: where the states stand
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
    RM: Floats | float
    RN: Floats | float
    dRM: Floats | float
    dRN: Floats | float
    if radius is None:
        meridian, normal = radii(latitude)
        RM, RN = meridian + height, normal + height
        bend = E2 * s * c / (1 - E2 * s * s)      # d ln N / dL; that of M is three times as much
        dRM, dRN, up = 3 * bend * meridian, bend * normal, 1.0
    else:
        RM = RN = float(radius)
        dRM = dRN = up = 0.0
        vU = np.zeros_like(vU)
    F = np.zeros((*np.broadcast(latitude, vE).shape, 6, 6))
    # phi x omega_in of the attitude rows
    wE, wN, wU = -vN / RM, OMEGA * c + vE / RN, OMEGA * s + vE * tan / RN
    F[..., E, N], F[..., E, U] = wU, -wN
    F[..., N, E], F[..., N, U] = -wU, wE
    F[..., U, E], F[..., U, N] = wN, -wE
    _add_turned_velocity(F, vE, vN, vU, RM, RN, tan, sec)
    # a wrong position: the Earth rate is taken elsewhere, the radii differ
    north_L, north_h = -vN / RM**2 * dRM, -vN / RM**2 * up
    east_L, east_h = -vE / RN**2 * dRN, -vE / RN**2 * up
    F[..., E, LAT], F[..., E, H] = -north_L, -north_h
    F[..., N, LAT], F[..., N, H] = -OMEGA * s + east_L, east_h
    F[..., U, LAT] = OMEGA * c + vE * sec**2 / RN + tan * east_L
    F[..., U, H] = tan * east_h
    F[..., LAT, LAT], F[..., LAT, H] = north_L, north_h
    F[..., LON, LAT] = vE * sec * tan / RN + sec * east_L
    F[..., LON, H] = sec * east_h
    return F


def _add_turned_velocity(F: Floats, vE: Floats | float, vN: Floats | float, vU: Floats,
                         RM: Floats | float, RN: Floats | float, tan: Floats | float,
                         sec: Floats | float) -> None:
    """Add what a velocity turned by phi, eq. (21), does to position and computed omega_in."""
    dv = np.zeros((*F.shape[:-2], 3, 3))                # rows dvE, dvN, dvU by phi
    dv[..., 0, 1], dv[..., 0, 2] = -vU, vN
    dv[..., 1, 0], dv[..., 1, 2] = vU, -vE
    dv[..., 2, 0], dv[..., 2, 1] = -vN, vE
    by_north, by_east = dv[..., 1, :] / _column(RM), dv[..., 0, :] / _column(RN)
    F[..., E, :3] -= by_north
    F[..., N, :3] += by_east
    F[..., U, :3] += by_east * _column(tan)
    F[..., LAT, :3] = by_north                          # (18), (22)
    F[..., LON, :3] = by_east * _column(sec)            # (19), (23)
    F[..., H, :3] = dv[..., 2, :]


def _column(x: Floats | float) -> Floats:
    return np.asarray(x)[..., None]


@dataclass(frozen=True, eq=False)
class Transition:
    """
    Response of the states since the first epoch: x = Phi x_0 + Gamma eps_b, eps_b constant.

    Phi : (m, 6, 6).   Gamma : (m, 6, 3), per rad/s in the axes of b.
    """

    Phi: NDArray[np.float64]
    Gamma: NDArray[np.float64]


def transition(path: Path, radius: float | None = None) -> Transition:
    """Return the transition matrices of a path, without a loop over its epochs."""
    S = _steps(path, radius, np.eye(3))
    _scan(S)
    return Transition(S[..., :6], S[..., 6:])


def propagate(path: Path, x_0: Floats | list[float], eps_b: Floats | list[float],
              radius: float | None = None) -> Floats:
    """
    Return the states at every epoch, (m, 6).

    path : leg.   x_0 : (6,) states at its first epoch.   eps_b : (3,) or (m - 1, 3) gyro drift in
    b, rad/s, constant or mean of each interval.   radius : see the module.
    """
    S = _steps(path, radius, np.asarray(eps_b, dtype=float)[..., None])
    _scan(S)
    x: Floats = S[..., :6] @ np.asarray(x_0, dtype=float) + S[..., 6]
    return x


def _steps(path: Path, radius: float | None, drift_b: Floats) -> Floats:
    """
    Return the transition of each epoch: (m, 6, 6 + k), [A | B], x_1 = A x_0 + B.

    drift_b : (..., 3, k) drifts in b, rad/s. The first row changes nothing.
    """
    S = np.zeros((len(path.t), 6, 6 + drift_b.shape[-1]))
    S[:1, range(6), range(6)] = 1.0
    drift_b = np.broadcast_to(drift_b, (len(S) - 1, *drift_b.shape[-2:]))
    chunk = 4096    # steps made at a time
    for first in range(0, len(S) - 1, chunk):      # what fits a cache is three times as fast
        own = slice(first, first + chunk)
        _fill(S[1:][own], path, slice(first, first + chunk + 1), own, radius, drift_b[own])
    return S


def _fill(S: Floats, path: Path, epochs: slice, intervals: slice, radius: float | None,
          drift_b: Floats) -> None:
    """Write [A | B] of some intervals into S; epochs: those at their edges."""
    dt = np.diff(path.t[epochs])[:, None, None]
    latitude, height = ((a[:-1] + a[1:]) / 2
                        for a in (path.latitude[epochs], path.height[epochs]))
    Fdt = coefficients(latitude, height, path.velocity_n[intervals], radius) * dt
    # exp(F dt) to second order: rates are of 1e-4 /s, the next term is 1e-13 in a second
    S[..., :6] = Fdt + Fdt @ Fdt / 2
    S[:, range(6), range(6)] += 1.0
    C_nb = path.C_nb[epochs]
    turned = (C_nb[:-1] + C_nb[1:]) * (dt / 2) @ drift_b
    # what came in during the interval has acted for half of it on average
    S[..., 6:] = Fdt[..., :3] @ turned / -2
    S[:, :3, 6:] -= turned


def _scan(S: Floats) -> None:
    """
    Turn steps into running compositions, in place: (n, 6, 6 + k), see _steps.

    Blocks are multiplied up side by side, their last rows by the same scan, and carried in.
    """
    block = 64    # steps that a scan multiplies up one after the other
    width = min(block, max(2, int(np.sqrt(len(S)))))
    for k in range(1, min(width, len(S))):
        now = S[k::width]
        now[:] = _after(now, S[k - 1::width][:len(now)])
    ends = S[width - 1::width].copy()
    if len(ends) > 1:
        _scan(ends)
    for k in range(width):
        now = S[width + k::width]
        now[:] = _after(now, ends[:len(now)])


def _after(then: Floats, first: Floats) -> Floats:
    """Return the map that does first and then: A2 A1 x + (A2 B1 + B2)."""
    both = then[..., :6] @ first
    both[..., 6:] += then[..., 6:]
    return both
