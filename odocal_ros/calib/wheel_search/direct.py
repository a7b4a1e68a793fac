# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Direct nonlinear least squares of left scale, right scale and heading on all fixes.

It checks the response surface, and gives condition number and correlations of the problem, and
whether positions separate left and right.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.wheel_search.planar import coefficients, loss, PlanarLeg, weights
from odocal_ros.calib.wheel_search.space import sets_of, Space
from odocal_ros.data.arrays import Floats

SETTLED = 1e-11      # judgement: relative, rad, largest last step
HALVINGS = 40    # judgement: of a step, at most
DIFFERENCE = np.array([-1.0, 1.0, 0.0])    # definition: right minus left
BENT = 1e-4          # judgement: share of path length: bend of any track by gyro, slip, tyres


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Result of least squares; x as in ``space``."""

    x: Floats
    value: float
    iterations: int
    settled: bool
    covariance: Floats  # (3, 3) of x by the scatter, without errors of start, gyro and lever arm
    condition: float         # of the Jacobian by relative scales (or both) and heading in rad
    sigma_difference: float  # of right minus left, relative; with a bend of the track by BENT

    @property
    def sigma(self) -> Floats:
        """Return the formal sigmas of x: (3,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Floats:
        """Return the correlations of x: (3, 3)."""
        return self.covariance / np.outer(self.sigma, self.sigma)


def least_squares(leg: PlanarLeg, x: Floats, space: Space, robust: bool = False) -> LeastSquares:
    """
    Return the parameters that minimise the (robust) mean square, by Gauss-Newton from x.

    leg : tracks and fixes.   x : (3,) first values: left, right (relative), heading (rad).
    space : free parameters.   robust : as in ``criteria.score``.
    """
    q = space.q_of(x)
    iterations, settled = 0, False
    r, J = _linear(leg, space.T @ q)
    value = _value(leg, r, robust)
    most = 200    # iterations; with reweighting a few are needed for each digit
    while not settled and iterations < most:
        iterations += 1
        root = np.sqrt(np.tile(weights(_d2(r), leg.sigma, robust), 2))
        step = _solve(root[:, None] * (J @ space.T), -root * r)
        for _ in range(HALVINGS):
            new, J_new = _linear(leg, space.T @ (q + step))
            lower = _value(leg, new, robust)
            if lower <= value:
                break
            step = step / 2
        else:
            settled = bool(np.abs(step).max() < SETTLED)
            break
        settled = bool(np.abs(step).max() < SETTLED) or \
            bool(np.abs(step).max() < 1e3 * SETTLED and lower == value)
        q, r, J, value = q + step, new, J_new, lower
    covariance, condition = _spread(leg, r, J, space, robust)
    # of right minus left: by scatter, and by the bend of any track
    reach, parts = np.linalg.norm(J[:, 2]), float(np.linalg.norm(J[:, 1] - J[:, 0])) / 2
    bent = BENT * reach / max(parts, 1e-12)
    return LeastSquares(space.T @ q, value, iterations, settled, covariance, condition,
                        float(np.sqrt(DIFFERENCE @ covariance @ DIFFERENCE + bent**2)))


def _linear(leg: PlanarLeg, x: Floats) -> tuple[Floats, Floats]:
    """Return residuals rotated by -heading, (2k,) m, and their Jacobian by x: (2k, 3)."""
    heading = x[2]
    by_x = np.zeros((4, 5))
    by_x[0] = coefficients(sets_of(leg, x))[0]
    by_x[1, 0], by_x[2, 1] = leg.scale_left / 2, leg.scale_right / 2
    by_x[3, 3:] = np.sin(heading), -np.cos(heading)
    rows = np.hstack([by_x @ axis for axis in leg.basis])
    return rows[0], rows[1:].T


def _d2(r: Floats) -> Floats:
    east, north = r.reshape(2, -1)
    return east**2 + north**2


def _value(leg: PlanarLeg, r: Floats, robust: bool) -> float:
    return float(loss(_d2(r)[None], leg.sigma, robust)[0])


def _solve(A: Floats, b: Floats) -> Floats:
    """Return the least-squares solution, with columns scaled to equal size."""
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    return np.linalg.lstsq(A / size, b, rcond=1e-14)[0] / size


def _spread(leg: PlanarLeg, r: Floats, J: Floats, space: Space,
            robust: bool) -> tuple[Floats, float]:
    """Return covariance of x and condition number."""
    w = np.tile(weights(_d2(r), leg.sigma, robust), 2)
    s = np.linalg.svd(J @ space.T if space.held else J, compute_uv=False)
    condition = float(s[0] / s[-1]) if s[-1] > 1e-15 * s[0] else np.inf
    root = np.sqrt(w)
    _, s, vt = np.linalg.svd(root[:, None] * (J @ space.T), full_matrices=False)
    s = np.maximum(s, 1e-15 * max(s[0], 1e-300))     # unobservable: a huge sigma
    freedom = max(len(r) - len(s), 1)
    to_x = space.T @ (vt.T / s)
    rows = (root * r).reshape(2, -1)
    return to_x @ to_x.T * ((rows**2).sum() / freedom * repeats(rows)), condition


def repeats(rows: Floats) -> float:
    """
    Return the number of residuals per independent one: 1 if white, many for a drift.

    rows : (2, k). One plus twice the sum of their autocorrelations before the first negative one.
    """
    k = rows.shape[1]
    spectrum = np.abs(np.fft.rfft(rows, 2 * k, axis=1))**2
    power = np.fft.irfft(spectrum.sum(axis=0), 2 * k)[:k]
    if not power[0] > 0:
        return 1.0
    correlation = power / power[0]
    end = np.argmax(correlation < 0) if (correlation < 0).any() else k
    return float(1 + 2 * correlation[1:end].sum())
