# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Least squares on a chain with a border, and its Schur complement: docs/method.md (S22) to (S24).

The normal matrix is block tridiagonal with a border of constants (an arrowhead). Blocks are
eliminated in order by Cholesky; back substitution gives the step and the joint covariance of each
pair of adjacent blocks and the border. Unknowns are scaled to a unit diagonal first: their sizes
differ by 1e20.

An hour has thousands of blocks. The equations, their elimination and the covariances use the same
memory in turn, which is in mapped files for long legs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import blocks, Floats, Ints, iterate_releasing, work_array
from odocal_ros.errors import OdocalError


class NotPositive(OdocalError):
    """The normal matrix is not positive definite; block : its first such block, -1: border."""

    def __init__(self, text: str, block: int = -1) -> None:
        super().__init__(text)
        self.block = block


class Normal:
    """
    Normal equations H x = g of N blocks of n unknowns and a border of m, initially zero.

    diagonal : (N, n, n).   beside : (N - 1, n, n), row k, column k + 1.   border : (N, n, m).
    corner : (m, m).   g, g_border : (N, n), (m,).   absent : prior weights of constants that no
    row depends on; they appear only in the results.
    """

    def __init__(self, N: int, n: int, m: int) -> None:
        self.diagonal = work_array(N, n, n)
        self.wide = work_array(N, n, n + m + 1)           # right-hand sides of the elimination
        self.beside = self.wide[:-1, :, :n]
        self.border = self.wide[:, :, n:n + m]
        self.g = self.wide[:, :, n + m]
        self.corner, self.g_border = np.zeros((m, m)), np.zeros(m)
        self.absent = np.zeros(0)


@dataclass(eq=False)
class Solved:
    """The step, and the factorisation from which the covariances are computed."""

    step: Floats              # (N, n)
    step_border: Floats       # (m,), here and below with the absent constants
    covariance: Floats        # (m, m) of the border
    log_determinant: float    # of H
    reduced: Floats           # (m, m) Schur complement of the border
    g_reduced: Floats         # (m,)
    _chain: tuple[Floats, Floats] | None    # (N, n, n + m + 1), (N, n, n); None after marginals
    _scale: Floats            # (N, n)
    _scale_border: Floats     # (m,) of those that are not absent
    taken: float = 1.0        # share of the full step

    def marginals(self) -> 'JointMarginals':
        """Return the joint marginals of adjacent blocks; callable once: it reuses the memory."""
        assert self._chain is not None, 'marginals() was already called'
        (wide, own), self._chain = self._chain, None
        N, n = self.step.shape
        m = len(self._scale_border)
        z = np.empty((n + m, n + m))          # of block k + 1 and the border, scaled
        corner = self.covariance[:m, :m] / np.multiply.outer(self._scale_border,
                                                             self._scale_border)
        H = wide[N - 1][:, n:n + m]
        z[n:, n:] = corner
        z[:n, n:] = -H @ corner
        z[n:, :n] = z[:n, n:].T
        z[:n, :n] = own[N - 1] - z[:n, n:] @ H.T
        own[N - 1], wide[N - 1, :, n:n + m] = z[:n, :n], z[:n, n:]
        for k in iterate_releasing(range(N - 2, -1, -1)):
            G = wide[k][:, :n + m]
            across = -G @ z
            own[k] -= across @ G.T
            G[:] = across
            z[:n, :n] = own[k]
            z[:n, n:] = across[:, n:]
            z[n:, :n] = across[:, n:].T
        return self._unscaled(own, wide[:, :, :n + m])

    def _unscaled(self, own: Floats, across: Floats) -> 'JointMarginals':
        """Return covariances in the units of the unknowns, computed in place."""
        n, s, s_c = own.shape[1], self._scale, self._scale_border
        for rows in blocks(len(own)):
            own[rows] *= s[rows, :, None] * s[rows, None, :]
            across[rows] *= s[rows, :, None]
            across[rows, :, n:] *= s_c
        for rows in blocks(len(own) - 1):
            across[rows, :, :n] *= s[rows.start + 1:rows.stop + 1, None, :]
        return JointMarginals(own, across, self.covariance[:len(s_c), :len(s_c)])

    def products(self, chain: Floats, border: Floats) -> tuple[Floats, Floats]:
        """
        Return g' H^-1 g of right-hand sides g, (r, r), and H^-1 g of the border, (m, r).

        chain : (N, n, r), border : (m, r).   Call it before ``marginals``.
        """
        assert self._chain is not None, 'call products() before marginals()'
        wide, own = self._chain
        N, n = self.step.shape
        m = len(self._scale_border)
        square = np.zeros((chain.shape[2],) * 2)
        rest = border * self._scale_border[:, None]
        y = np.zeros((n, chain.shape[2]))
        for k in iterate_releasing(range(N)):
            y = chain[k] * self._scale[k][:, None] - y
            square += y.T @ own[k] @ y
            eliminated = wide[k][:, :n + m].T @ y
            rest -= eliminated[n:]
            y = eliminated[:n]
        rest /= self._scale_border[:, None]
        moved = self.covariance[:, :m] @ rest
        return square + rest.T @ moved[:m], moved


@dataclass(frozen=True, eq=False)
class JointMarginals:
    """
    Joint marginals: the covariance of block k, block k + 1 and the border, for N - 1 intervals.

    The full array would be (N - 1, 2n + m, 2n + m); a few intervals are computed at a time.
    """

    _own: Floats              # (N, n, n) covariance of each block
    _across: Floats           # (N, n, n + m) with the next block and the border
    _corner: Floats           # (m, m)

    def __len__(self) -> int:
        return len(self._own) - 1

    def __getitem__(self, k: int) -> Floats:
        """Return the covariance of one interval: (2n + m, 2n + m)."""
        out: Floats = self.covariances(np.array([k % len(self)]))[0]
        return out

    def covariances(self, rows: Ints) -> Floats:
        """Return the covariances of the intervals of an index array: (r, 2n + m, 2n + m)."""
        n, size = self._own.shape[1], self._across.shape[2] + self._own.shape[1]
        out = np.empty((len(rows), size, size))
        across, after = self._across[rows], self._across[rows + 1][:, :, n:]
        out[:, :n, :n], out[:, :n, n:] = self._own[rows], across
        out[:, n:, :n] = np.swapaxes(across, 1, 2)
        out[:, n:2 * n, n:2 * n], out[:, n:2 * n, 2 * n:] = self._own[rows + 1], after
        out[:, 2 * n:, n:2 * n] = np.swapaxes(after, 1, 2)
        out[:, 2 * n:, 2 * n:] = self._corner
        return out

    def variances(self) -> Floats:
        """Return the variance of each unknown of each block: (N, n)."""
        # copies: views would be read again after their memory is released
        own = [np.einsum('kii->ki', self._own[rows]).copy() for rows in blocks(len(self._own))]
        return np.concatenate(own)

    def with_next(self) -> Floats:
        """Return the covariance of each unknown with itself in the next block: (N - 1, n)."""
        n = self._own.shape[1]
        return np.concatenate([np.einsum('kii->ki', self._across[rows, :, :n]).copy()
                               for rows in blocks(len(self))])

    def variances_of(self, rows: Ints, own: Floats, border: Floats, ahead: Floats | None,
                     ahead_columns: slice) -> Floats:
        """
        Return the variances of sums over the unknowns of some intervals: (k, c).

        own, border : (k, n, c), (k, m, c) factors of block and border.   ahead : (k, a, c) of the
        unknowns ``ahead_columns`` of the next block, or None.
        """
        n, across = own.shape[1], self._across[rows]
        by_own = self._own[rows] @ own + 2 * (across[:, :, n:] @ border)
        by_border = self._corner @ border
        if ahead is not None:
            by_own += 2 * (across[:, :, :n][:, :, ahead_columns] @ ahead)
            by_ahead = self._own[rows + 1][:, ahead_columns, ahead_columns] @ ahead
            by_ahead += 2 * (self._across[rows + 1][:, ahead_columns, n:] @ border)
        out: Floats = (own * by_own).sum(axis=1) + (border * by_border).sum(axis=1)
        return out if ahead is None else out + (ahead * by_ahead).sum(axis=1)

    def covariance_form(self, rows: slice, J: Floats) -> Floats:
        """
        Return a matrix with the quadratic form of the covariance of rows: (k, r, r).

        J : (k, r, 2n + m).   The matrix A is not symmetric: a' A a is the variance of a' times the
        rows.
        """
        n, ends = self._own.shape[1], slice(rows.start + 1, rows.stop + 1)
        across, after = self._across[rows], self._across[ends][:, :, n:]
        own, end, border = J[:, :, :n], J[:, :, n:2 * n], J[:, :, 2 * n:]
        by_own = own @ self._own[rows] + 2 * (end @ np.swapaxes(across[:, :, :n], 1, 2))
        by_border = border @ self._corner + 2 * (own @ across[:, :, n:] + end @ after)
        out: Floats = by_own @ np.swapaxes(own, 1, 2) + by_border @ np.swapaxes(border, 1, 2)
        out += end @ self._own[ends] @ np.swapaxes(end, 1, 2)
        return out

    def blocks(self) -> Iterator[Floats]:
        """Yield the covariances of all intervals in chunks: (k, 2n + m, 2n + m)."""
        for rows in blocks(len(self)):
            yield self.covariances(np.arange(rows.start, rows.stop))


def solve(normal: Normal) -> Solved:
    """Solve normal equations in place; raises NotPositive: an unknown is not constrained."""
    from scipy.linalg.lapack import dpotrf, dpotrs
    wide = normal.wide
    N, n = normal.g.shape
    m = len(normal.g_border)
    s, s_c = _scale(normal)
    corner = np.zeros((m + 1, m + 1))
    corner[:m, :m] = normal.corner * np.multiply.outer(s_c, s_c)
    corner[:m, m] = corner[m, :m] = normal.g_border * s_c
    roots = _eliminate(normal, corner)
    root, info = dpotrf(corner[:m, :m], lower=1)
    if info:
        raise NotPositive('the data do not determine the constants of the vehicle')
    logdet = 2 * sum(np.log(x).sum() for x in (roots / s, root.diagonal() / s_c)) \
        + np.log(normal.absent).sum()
    reduced = (corner[:m, :m] + corner[:m, :m].T) / 2 / np.multiply.outer(s_c, s_c)
    c = dpotrs(root, corner[:m, m], lower=1)[0].ravel()
    covariance = dpotrs(root, np.eye(m), lower=1)[0]
    x = np.concatenate([wide[rows, :, n + m] - wide[rows, :, n:n + m] @ c
                        for rows in blocks(N)])
    for k in iterate_releasing(range(N - 2, -1, -1)):
        x[k] -= wide[k][:, :n] @ x[k + 1]
    absent = normal.absent
    return Solved(
        x * s, _with_absent(c * s_c, 0 * absent),
        _with_absent(covariance * np.multiply.outer(s_c, s_c), 1 / absent), float(logdet),
        _with_absent(reduced, absent), _with_absent(corner[:m, m] / s_c, 0 * absent),
        (wide, normal.diagonal), s, s_c)


def _scale(normal: Normal) -> tuple[Floats, Floats]:
    """Scale the blocks to a unit diagonal, in place; return the factors: (N, n), (m,)."""
    diagonal, wide = normal.diagonal, normal.wide
    N, n = normal.g.shape
    s = np.ones((N + 1, n))     # of N blocks and of one after the last, which is not used
    for rows in blocks(N):
        s[rows] = 1 / np.sqrt(np.maximum(np.einsum('kii->ki', diagonal[rows]), 1e-300))
    s_c: Floats = 1 / np.sqrt(np.maximum(np.diag(normal.corner), 1e-300))
    for rows in blocks(N):
        diagonal[rows] *= s[rows, :, None]
        diagonal[rows] *= s[rows, None, :]
        wide[rows] *= s[rows, :, None]
        wide[rows, :, :n] *= s[rows.start + 1:rows.stop + 1, None, :]
        normal.border[rows] *= s_c
    return s[:N], s_c


def _eliminate(normal: Normal, corner: Floats) -> Floats:
    """Eliminate the blocks and reduce the corner, in place; return their roots' diagonals."""
    from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
    diagonal, wide = normal.diagonal, normal.wide
    N, n = normal.g.shape
    D, roots = diagonal[0], np.empty((N, n))
    for k in iterate_releasing(range(N)):
        root, info = dpotrf(D, lower=1)
        if info:
            raise NotPositive(f'the data do not determine block {k} of {N}', k)
        W = wide[k]
        X, _ = dpotrs(root, W, lower=1)
        roots[k] = root.diagonal()
        corner -= W[:, n:].T @ X[:, n:]
        if k + 1 < N:
            onward = W[:, :n].T @ X
            D = diagonal[k + 1] - onward[:, :n]
            wide[k + 1, :, n:] -= onward[:, n:]
        diagonal[k] = dpotri(root, lower=1)[0]
        W[:] = X
    below = np.tril_indices(n, -1)      # dpotri fills one triangle
    for rows in blocks(N):
        diagonal[rows, below[1], below[0]] = diagonal[rows, below[0], below[1]]
    return roots


def _with_absent(x: Floats, absent: Floats) -> Floats:
    """Return a vector, or a matrix by its diagonal, with the absent constants: (m,), (m, m)."""
    if x.ndim == 1:
        return np.concatenate([x, absent])
    out = np.diag(np.concatenate([np.zeros(len(x)), absent]))
    out[:len(x), :len(x)] = x
    return out
