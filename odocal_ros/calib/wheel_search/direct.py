# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Direct nonlinear least squares of left scale, right scale and heading on all fixes.

The check of the response surface, and what it says of the problem itself: condition number,
correlations, and whether positions separate left and right at all.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheel_search.criteria import loss, weights
from odocal_ros.calib.wheel_search.planar import coefficients, PlanarLeg
from odocal_ros.calib.wheel_search.space import sets_of, Space
from odocal_ros.data.arrays import Floats

SETTLED = 1e-11      # judgement: relative, rad, the last step
HALVINGS = 40    # judgement: of a step, at most
DIFFERENCE = np.array([-1.0, 1.0, 0.0])    # definition: right less left
BENT = 1e-4          # judgement: of path length: bend of any track by gyro, slip and tyres


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """
    What least squares say; x as in ``space``.

    covariance : (3, 3) of x by the scatter of the residuals, correlated ones counted as
        fewer; where the difference was held, left and right err equally. Errors of start, gyro and
        lever arm are not in it.
    condition : of the Jacobian by relative left, right scale (or both) and heading in rad.
    sigma_difference : of right less left, relative; besides the scatter it allows for a track
        bent by BENT of path length, which the difference of the wheels would explain as well.
    """

    x: NDArray[np.float64]
    value: float
    iterations: int
    settled: bool
    covariance: NDArray[np.float64]
    condition: float
    sigma_difference: float

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Return the formal sigmas of x: (3,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Return the correlations of x: (3, 3)."""
        return self.covariance / np.outer(self.sigma, self.sigma)


def least_squares(leg: PlanarLeg, x: Floats, space: Space, robust: bool = False) -> LeastSquares:
    """
    Return the parameters that lower the (robust) mean square, by Gauss-Newton from x.

    leg : what was driven.   x : (3,) where to begin: left, right (relative), heading (rad).
    space : which parameters there are.   robust : as in ``criteria.score``.
    """
    q = space.q_of(x)
    iterations, settled = 0, False
    r, J = _linear(leg, space.T @ q)
    value = _value(leg, r, robust)
    most = 200    # rounds; reweighting converges by a digit in a few
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
    return LeastSquares(space.T @ q, value, iterations, settled, covariance, condition,
                        _sigma_difference(J, covariance))


def _linear(leg: PlanarLeg, x: Floats) -> tuple[Floats, Floats]:
    """Return residuals turned back by the heading, (2k,) m, and their Jacobian by x: (2k, 3)."""
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
    """Return the least-squares solution, columns scaled to one size first."""
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
    s = np.maximum(s, 1e-15 * max(s[0], 1e-300))     # what is not seen at all: a huge sigma
    freedom = max(len(r) - len(s), 1)
    to_x = space.T @ (vt.T / s)
    rows = (root * r).reshape(2, -1)
    return to_x @ to_x.T * ((rows**2).sum() / freedom * repeats(rows)), condition


def _sigma_difference(J: Floats, covariance: Floats) -> float:
    """Return the sigma of right less left: by scatter, and by a track bent as all are."""
    reach, parts = np.linalg.norm(J[:, 2]), float(np.linalg.norm(J[:, 1] - J[:, 0])) / 2
    bent = BENT * reach / max(parts, 1e-12)
    return float(np.sqrt(DIFFERENCE @ covariance @ DIFFERENCE + bent**2))


def repeats(rows: Floats) -> float:
    """
    Return the number of correlated residuals: 1 for white ones, many for a drift.

    rows : (2, k). One and twice the sum of their autocorrelations up to the first negative one.
    """
    k = rows.shape[1]
    spectrum = np.abs(np.fft.rfft(rows, 2 * k, axis=1))**2
    power = np.fft.irfft(spectrum.sum(axis=0), 2 * k)[:k]
    if not power[0] > 0:
        return 1.0
    alike = power / power[0]
    end = np.argmax(alike < 0) if (alike < 0).any() else k
    return float(1 + 2 * alike[1:end].sum())
