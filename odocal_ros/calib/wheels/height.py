# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Pitch and tilt by the heights of the fixes: what shortens a track in the level.

A pitch of 1 deg that is not known makes a scale 152 ppm too large. Heights tell the climb of the
track against that of the way, be it a mounting angle or a level that drifts.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.two_point import PITCH_LIMIT, PITCH_PRIOR
from odocal_ros.calib.wheels.judge_noise import slow_means, spread
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import Bins, Equations, State
from odocal_ros.calib.wheels.noise import node_covariance
from odocal_ros.data.arrays import Bools, Floats


@dataclass(frozen=True, eq=False)
class Height:
    """
    What heights say.

    pitch, pitch_sigma : rad, mounting and level together, the prior where not known.
    start : m, height of the antenna at the start mark.   phi : (N + 1, 2) rad, tilt about east
    and north.   climb_variance : rad^2, mean over the way of what is not known of its climb.
    tilt_variance : (N + 1,) rad^2, of the level at the nodes, mean of two axes.
    """

    pitch: float
    pitch_sigma: float
    start: float
    phi: NDArray[np.float64]
    climb_variance: float
    tilt_variance: NDArray[np.float64]
    known: bool


def solve_height(leg: WheelLeg, eq: Equations, bins: Bins, state: State, since: float) -> Height:
    """Solve the vertical part: height at the start, pitch, and tilt at the nodes."""
    n, a = len(eq.turn), leg.alignment
    unknown = Height(0.0, PITCH_PRIOR, float(np.nan_to_num(state.start_n[2])),
                     np.zeros((n + 1, 2)), PITCH_PRIOR**2, np.full(n + 1, a.level_sigma**2), False)
    r = eq.residual[:, 2]
    use = bins.filled & np.isfinite(r)
    if use.sum() < max(4, 0.5 * bins.filled.sum()):
        return unknown
    L = np.concatenate([eq.by_phi[:, :, 1], -eq.by_phi[:, :, 0]], -1)      # (N, 2 (N + 1))
    wander = sum(node_covariance(bins.edges, since, a).values())
    axes = np.concatenate([eq.phi_axes[:, 0], eq.phi_axes[:, 1]]) * a.gyro_bias_sigma
    Q = np.kron(np.eye(2), wander + a.level_sigma**2) + axes @ axes.T
    r = np.nan_to_num(r + L @ state.phi[:, :2].T.ravel())
    X = np.stack([np.ones(n), eq.by[:, 2, 3]], -1)
    known = L @ Q @ L.T
    keep = use
    for _ in range(3):
        use = keep
        V = known + _fix_noise(leg, bins, r, use)
        found = _solve(V, r, X, use, L @ Q, state)
        if found is None:
            return unknown
        delta, covariance, phi, P, cross, off = found
        far = use & (off > 4.0)     # sigmas: of 100 bins one in 160 legs by chance
        if not far.any():
            break
        keep = use & ~far
    sigma = float(np.sqrt(covariance[1, 1]))
    pitch = state.pitch + float(delta[1])
    # judgement: no pitch is taken from heights that hardly tell more than its prior
    if sigma > 0.3 * PITCH_PRIOR or abs(pitch) > PITCH_LIMIT:
        return unknown
    tilt = np.diag(Q) - np.einsum('ij,ik,kj->j', (L @ Q)[use], P, (L @ Q)[use], optimize=True)
    return Height(pitch, sigma, float(state.start_n[2] + delta[0]), phi.reshape(2, -1).T,
                  _climb(eq, Q, L[use], P, cross, sigma),
                  np.maximum(tilt.reshape(2, -1).mean(axis=0), 0.0), True)


def _fix_noise(leg: WheelLeg, bins: Bins, r: Floats, use: Bools) -> Floats:
    """
    Return the covariance of bin means of the heights, (N, N) m^2.

    Half of the variance stated is white, half lasts for a minute, as heights of receivers do.
    """
    n = len(bins.edges) - 1
    stated = leg.covariance_n[bins.fix, 2, 2]
    mean = bins.mean(stated)
    white = np.bincount(bins.of_fix, stated * bins.share**2, n)
    slow = slow_means(*spread(bins, leg.t_fix), 60.0)
    root = np.sqrt(mean)
    return np.diag(0.5 * white + 1e-6) + 0.5 * root[:, None] * slow * root


def _solve(V: Floats, r: Floats, X: Floats, use: Bools, LQ: Floats,
           state: State) -> tuple[Any, ...] | None:
    inverse = np.linalg.inv(V[np.ix_(use, use)])
    right = X[use].T @ inverse
    # the prior of the pitch, weakly of the height: 3 km
    weight = np.array([1 / 30.0**2 * 1e-4, 1 / PITCH_PRIOR**2])
    covariance = np.linalg.inv(right @ X[use] + np.diag(weight))
    delta = covariance @ (right @ r[use] - weight * [0.0, state.pitch])
    if not np.isfinite(delta).all():
        return None
    left = inverse @ (r[use] - X[use] @ delta)
    P = inverse - right.T @ covariance @ right
    off = np.zeros(len(r))
    off[use] = np.abs(left) / np.sqrt(np.maximum(np.diag(P), 1e-12))
    return delta, covariance, LQ[use].T @ left, P, -(covariance @ right @ LQ[use])[1], off


def _climb(eq: Equations, Q: Floats, L: Floats, P: Floats, cross: Floats, sigma: float) -> float:
    """Return the mean variance of the climb of the track after the fit, rad^2."""
    n = len(eq.turn)
    level = eq.forward[:, :2] / np.maximum(np.hypot(*eq.forward[:, :2].T), 1e-9)[:, None]
    k = np.arange(n)
    E = np.zeros((n, 2 * (n + 1)))      # climb by the tilt of nodes
    for side in (0, 1):
        E[k, k + side] = level[:, 1] / 2
        E[k, n + 1 + k + side] = -level[:, 0] / 2
    G = E @ Q @ L.T
    after = np.einsum('ij,jk,ik->i', E, Q, E) - np.einsum('ij,jk,ik->i', G, P, G)
    after = after + 2 * E @ cross + sigma**2
    share = eq.length / max(eq.length.sum(), 1e-9)
    return float(share @ np.maximum(after, 0.0))
