"""
Least squares on a chain: blocks that touch their neighbours only, and a border that touches all.

The normal matrix is block tridiagonal with a border of constants. Blocks are eliminated one after
the other by Cholesky; the way back gives the step, and the covariance of each pair of neighbours
with the border. Unknowns are scaled to a unit diagonal first: they differ by 1e20 in size.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.errors import OdocalError

Floats = NDArray[np.float64]


class NotPositive(OdocalError):
    """The normal matrix is not positive definite: nothing holds some unknown."""


@dataclass(eq=False)
class Normal:
    """Normal equations H x = g of N blocks of n unknowns and a border of m."""

    diagonal: Floats      # (N, n, n)
    beside: Floats        # (N - 1, n, n): row k, column k + 1
    border: Floats        # (N, n, m)
    corner: Floats        # (m, m)
    g: Floats             # (N, n)
    g_border: Floats      # (m,)

    @classmethod
    def zeros(cls, N, n, m):
        """Return equations that say nothing."""
        return cls(np.zeros((N, n, n)), np.zeros((N - 1, n, n)), np.zeros((N, n, m)),
                   np.zeros((m, m)), np.zeros((N, n)), np.zeros(m))


@dataclass(frozen=True, eq=False)
class Solved:
    """Step, and what the covariances are made from."""

    step: Floats              # (N, n)
    step_border: Floats       # (m,)
    covariance: Floats        # (m, m) of the border
    log_determinant: float    # of H
    reduced: Floats           # (m, m) of the border, all blocks eliminated
    g_reduced: Floats         # (m,)
    _back: Floats             # (N, n, n + m)
    _own: Floats              # (N, n, n)
    _scale: Floats            # (N, n)
    _scale_border: Floats     # (m,)

    def neighbours(self):
        """
        Return the covariance of block k, block k + 1 and the border: (N - 1, 2n + m, 2n + m).

        Also, in the last place, nothing is lost: block N - 1 stands second in the last one.
        """
        N, n = self.step.shape
        m = len(self.step_border)
        z = np.empty((n + m, n + m))          # of block k + 1 and the border, scaled
        out = np.empty((N - 1, 2 * n + m, 2 * n + m))
        corner = self.covariance / np.multiply.outer(self._scale_border, self._scale_border)
        H = self._back[N - 1][:, n:]
        z[n:, n:] = corner
        z[:n, n:] = -H @ corner
        z[n:, :n] = z[:n, n:].T
        z[:n, :n] = self._own[N - 1] - z[:n, n:] @ H.T
        for k in range(N - 2, -1, -1):
            G = self._back[k]
            across = -G @ z
            here = out[k]
            here[n:, n:] = z
            here[:n, n:] = across
            here[n:, :n] = across.T
            here[:n, :n] = self._own[k] - across @ G.T
            z = z.copy()
            z[:n, :n] = here[:n, :n]
            z[:n, n:] = across[:, n:]
            z[n:, :n] = across[:, n:].T
        scale = np.concatenate([self._scale[:-1], self._scale[1:],
                                np.tile(self._scale_border, (N - 1, 1))], axis=1)
        out *= scale[:, :, None]
        out *= scale[:, None, :]
        return out


def solve(normal: Normal) -> Solved:
    """
    Solve the normal equations.

    Raises
    ------
    NotPositive
        The equations leave something undetermined beyond rounding.

    """
    from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
    N, n = normal.g.shape
    m = len(normal.g_border)
    s = 1 / np.sqrt(np.maximum(np.einsum('kii->ki', normal.diagonal), 1e-300))
    s_c = 1 / np.sqrt(np.maximum(np.diag(normal.corner), 1e-300))
    diagonal = normal.diagonal * s[:, :, None] * s[:, None, :]
    # columns to be carried: the next block, the border, the right side
    wide = np.concatenate([
        np.concatenate([normal.beside * s[:-1, :, None] * s[1:, None, :],
                        np.zeros((1, n, n))]),
        normal.border * s[:, :, None] * s_c, (normal.g * s)[:, :, None]], axis=2)
    corner = np.zeros((m + 1, m + 1))
    corner[:m, :m] = normal.corner * np.multiply.outer(s_c, s_c)
    corner[:m, m] = corner[m, :m] = normal.g_border * s_c
    back = np.empty((N, n, n + m))
    right = np.empty((N, n))
    own = np.empty((N, n, n))
    logdet = -2 * np.log(s).sum() - 2 * np.log(s_c).sum()
    D = diagonal[0]
    for k in range(N):
        root, info = dpotrf(D, lower=1)
        if info:
            raise NotPositive(f'nothing holds keyframe {k} of {N}')
        W = wide[k]
        X, _ = dpotrs(root, W, lower=1)
        back[k], right[k] = X[:, :n + m], X[:, n + m]
        own[k] = dpotri(root, lower=1)[0]
        logdet += 2 * np.log(root.diagonal()).sum()
        corner -= W[:, n:].T @ X[:, n:]
        if k + 1 < N:
            E = W[:, :n].T
            D = diagonal[k + 1] - E @ X[:, :n]
            wide[k + 1, :, n:] -= E @ X[:, n:]
    # dpotri fills one triangle
    lower = np.tril(own)
    own = lower + np.swapaxes(np.tril(own, -1), 1, 2)
    root, info = dpotrf(corner[:m, :m], lower=1)
    if info:
        raise NotPositive('the constants are not determined')
    logdet += 2 * np.log(root.diagonal()).sum()
    reduced = (corner[:m, :m] + corner[:m, :m].T) / 2 / np.multiply.outer(s_c, s_c)
    c = dpotrs(root, corner[:m, m], lower=1)[0].ravel()
    covariance = dpotrs(root, np.eye(m), lower=1)[0]
    x = np.empty((N, n))
    x[N - 1] = right[N - 1] - back[N - 1][:, n:] @ c
    fixed = right - back[:, :, n:] @ c
    for k in range(N - 2, -1, -1):
        x[k] = fixed[k] - back[k][:, :n] @ x[k + 1]
    return Solved(x * s, c * s_c, covariance * np.multiply.outer(s_c, s_c), float(logdet),
                  reduced, corner[:m, m] / s_c, back, own, s, s_c)
