# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Generalised least squares of the wheels, with the gyro's drift as what is left over."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheels.judge_noise import inverse_root
from odocal_ros.calib.wheels.model import (
    Equations,
    FIX_LAG2,
    GYRO,
    LATENCY,
    OFFSET,
    PARAMETERS,
    RATIO,
    SCALE,
    WIDTH,
)
from odocal_ros.data.arrays import Bools, Floats


@dataclass(frozen=True, eq=False)
class Fit:
    """
    A solved step.

    step : (p,).   normal : (p, p) its inverse covariance.   B : (p, 3N) observations to step.
    use : (3N,) observations used, u of them.   P : (u, u) inverse covariance less what the
    parameters take up.   left : (u,) V^-1 times what is left.   phi : (N + 1,) rad, drift
    of the heading at the nodes but for the gyro's scale.   phi_sigma : (N + 1,) rad, of that and
    the gyro's scale together.
    """

    step: NDArray[np.float64]
    normal: NDArray[np.float64]
    B: NDArray[np.float64]
    use: NDArray[np.bool_]
    P: NDArray[np.float64]
    left: NDArray[np.float64]
    phi: NDArray[np.float64]
    phi_sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drift:
    """
    Drift of the heading at the nodes.

    L : (3N, N + 1) what it makes of the observations.   Q : (N + 1, N + 1) its covariance, but for
    the gyro's scale.   by_gyro_scale : (N + 1,) what that makes of it.
    """

    L: NDArray[np.float64]
    Q: NDArray[np.float64]
    by_gyro_scale: NDArray[np.float64]


def least_squares(V: Floats, r: Floats, X: Floats, drift: Drift, use: Bools, weight: Floats,
                  value: Floats) -> Fit:
    """
    Solve r = X step + e, cov e = V, with priors, and the drift: docs/method.md (W12), (W13).

    The drift's share of e is L phi.

    Parameters
    ----------
    V, r, X : (3N, 3N), (3N,), (3N, p) arrays
        Covariance, residuals, derivatives.
    drift : Drift
        Of the heading.
    use : (3N,) bool array
        Observations to use.
    weight, value : (p,) arrays
        Inverse prior variance of each step, and the prior's value.

    """
    root = inverse_root(V[np.ix_(use, use)])
    inverse = root.T @ root
    Xu, ru, LQ = X[use], r[use], drift.L[use] @ drift.Q
    right = Xu.T @ inverse
    normal = right @ Xu + np.diag(weight)
    covariance = np.linalg.inv(normal)
    step = covariance @ (right @ ru + weight * value)
    B = np.zeros((len(step), len(r)))
    B[:, use] = covariance @ right
    P = inverse - right.T @ covariance @ right
    left = inverse @ (ru - Xu @ step)
    variance = np.diag(drift.Q) - np.einsum('ij,ij->j', LQ, P @ LQ)
    both = -(covariance[GYRO] @ right) @ LQ     # covariance of the drift and the gyro's scale
    variance += drift.by_gyro_scale * (covariance[GYRO, GYRO] * drift.by_gyro_scale + 2 * both)
    return Fit(step, normal, B, use, P, left, LQ.T @ left, np.sqrt(np.maximum(variance, 0.0)))


def design(eq: Equations) -> Floats:
    """Return the derivatives of the observations by the parameters, (3N, p)."""
    n = len(eq.turn)
    X = np.zeros((3 * n, len(PARAMETERS)))
    for axis in range(2):
        rows = slice(axis * n, (axis + 1) * n)
        X[rows, :3] = eq.by[:, axis, :3]
        X[rows, 3 + axis] = 1.0
        X[rows, LATENCY], X[rows, GYRO], X[rows, FIX_LAG2] = eq.by[:, axis, 4:].T
    X[2 * n:, [SCALE, RATIO, WIDTH, OFFSET, GYRO]] = eq.turn_by
    return X
