# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Solver of the normal equations of a fit: docs/method.md (S22) to (S24).

The unknowns are a chain of N blocks (keyframes) of n, and m constants that all blocks share. The
normal matrix is block tridiagonal, bordered by the constants (an arrowhead). ``solve`` eliminates
the blocks in order by Cholesky. Back substitution gives the step, and the joint covariance of
each pair of adjacent blocks with the constants. Unknowns are scaled to a unit diagonal first:
their sizes differ by 1e20.

An hour has thousands of blocks. The equations, their elimination and the covariances use the same
memory in turn, which is in mapped files for long legs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from odocal_ros.data.arrays import blocks, Floats, Ints, iterate_releasing, work_array
from odocal_ros.errors import OdocalError


class NotPositive(OdocalError):
    """The normal matrix is not positive definite; block : first such block, -1: constants."""

    def __init__(self, text: str, block: int = -1) -> None:
        super().__init__(text)
        self.block = block


class NormalEquations:
    """
    Normal equations H x = g of N blocks of n unknowns and of m constants, initially zero.

    diagonal : (N, n, n) H_k.   upper : (N - 1, n, n) H_k,k+1.   coupling : (N, n, m) of blocks and
    constants.   corner : (m, m) of the constants.   g, g_constants : (N, n), (m,).
    unused_weights : prior weights of further constants, on which no row depends.
    """

    def __init__(self, N: int, n: int, m: int) -> None:
        self.diagonal = work_array(N, n, n)
        # upper, coupling and g side by side: the elimination multiplies all by H_k^-1
        self.right_sides = work_array(N, n, n + m + 1)
        self.upper = self.right_sides[:-1, :, :n]
        self.coupling = self.right_sides[:, :, n:n + m]
        self.g = self.right_sides[:, :, n + m]
        self.corner, self.g_constants = np.zeros((m, m)), np.zeros(m)
        self.unused_weights = np.zeros(0)


@dataclass(eq=False)
class Solution:
    """The solution, and the elimination from which the covariances are computed."""

    step: Floats              # (N, n) of the blocks
    step_constants: Floats    # (m,), here and in the next four with unused constants
    covariance: Floats        # (m, m) of the constants
    log_determinant: float    # of H
    reduced: Floats           # (m, m) Schur complement of the constants, (S24)
    g_reduced: Floats         # (m,) its right-hand side
    # (N, n, n + m + 1) H_k^-1 times the right sides, (N, n, n) H_k^-1 of the eliminated chain;
    # None after ``marginals``, which reuses their memory
    _elimination: tuple[Floats, Floats] | None
    _scale: Floats            # (N, n)
    _scale_constants: Floats  # (m,) of the used ones
    step_fraction: float = 1.0    # of the full Gauss-Newton step that ``step`` is

    def marginals(self) -> 'JointMarginals':
        """Return the joint marginals of adjacent blocks; callable once: it reuses the memory."""
        assert self._elimination is not None, 'marginals() was already called'
        (gains, diagonal), self._elimination = self._elimination, None
        N, n = self.step.shape
        m = len(self._scale_constants)
        after = np.empty((n + m, n + m))      # covariance of block k + 1 and the constants, scaled
        corner = self.covariance[:m, :m] / np.multiply.outer(self._scale_constants,
                                                             self._scale_constants)
        G = gains[N - 1][:, n:n + m]
        after[n:, n:] = corner
        after[:n, n:] = -G @ corner
        after[n:, :n] = after[:n, n:].T
        after[:n, :n] = diagonal[N - 1] - after[:n, n:] @ G.T
        diagonal[N - 1], gains[N - 1, :, n:n + m] = after[:n, :n], after[:n, n:]
        for k in iterate_releasing(range(N - 2, -1, -1)):
            G = gains[k][:, :n + m]
            cross = -G @ after
            diagonal[k] -= cross @ G.T
            G[:] = cross
            after[:n, :n] = diagonal[k]
            after[:n, n:] = cross[:, n:]
            after[n:, :n] = cross[:, n:].T
        return self._unscaled(diagonal, gains[:, :, :n + m])

    def _unscaled(self, diagonal: Floats, cross: Floats) -> 'JointMarginals':
        """Return the joint marginals in the units of the unknowns, computed in place."""
        n, s, s_c = diagonal.shape[1], self._scale, self._scale_constants
        for rows in blocks(len(diagonal)):
            diagonal[rows] *= s[rows, :, None] * s[rows, None, :]
            cross[rows] *= s[rows, :, None]
            cross[rows, :, n:] *= s_c
        for rows in blocks(len(diagonal) - 1):
            cross[rows, :, :n] *= s[rows.start + 1:rows.stop + 1, None, :]
        return JointMarginals(diagonal, cross, self.covariance[:len(s_c), :len(s_c)])

    def quadratic_forms(self, g: Floats, g_constants: Floats) -> tuple[Floats, Floats]:
        """
        Return G' H^-1 G of r right-hand sides G, (r, r), and of H^-1 G the constants, (m, r).

        g : (N, n, r) of the blocks.   g_constants : (m, r).   Call it before ``marginals``.
        """
        assert self._elimination is not None, 'call quadratic_forms() before marginals()'
        gains, inverse = self._elimination
        N, n = self.step.shape
        m = len(self._scale_constants)
        forms = np.zeros((g.shape[2],) * 2)
        g_reduced = g_constants * self._scale_constants[:, None]
        y = np.zeros((n, g.shape[2]))
        for k in iterate_releasing(range(N)):
            y = g[k] * self._scale[k][:, None] - y
            forms += y.T @ inverse[k] @ y
            eliminated = gains[k][:, :n + m].T @ y
            g_reduced -= eliminated[n:]
            y = eliminated[:n]
        g_reduced /= self._scale_constants[:, None]
        solution = self.covariance[:, :m] @ g_reduced
        return forms + g_reduced.T @ solution[:m], solution


@dataclass(frozen=True, eq=False)
class JointMarginals:
    """
    Joint marginals: the covariance of block k, block k + 1 and the constants, for N - 1 intervals.

    The full array would be (N - 1, 2n + m, 2n + m); a few intervals are computed at a time.
    """

    _diagonal: Floats         # (N, n, n) of each block
    _cross: Floats            # (N, n, n + m) of each block with the next one and the constants
    _corner: Floats           # (m, m) of the constants

    def __len__(self) -> int:
        return len(self._diagonal) - 1

    def __getitem__(self, k: int) -> Floats:
        """Return the covariance of interval k: (2n + m, 2n + m)."""
        out: Floats = self.covariances(np.array([k % len(self)]))[0]
        return out

    def covariances(self, rows: Ints) -> Floats:
        """Return the covariances of intervals, an index array (r,): (r, 2n + m, 2n + m)."""
        n = self._diagonal.shape[1]
        out = np.empty((len(rows), *[n + self._cross.shape[2]] * 2))
        cross, after = self._cross[rows], self._cross[rows + 1][:, :, n:]
        out[:, :n, :n], out[:, :n, n:] = self._diagonal[rows], cross
        out[:, n:, :n] = np.swapaxes(cross, 1, 2)
        out[:, n:2 * n, n:2 * n], out[:, n:2 * n, 2 * n:] = self._diagonal[rows + 1], after
        out[:, 2 * n:, n:2 * n] = np.swapaxes(after, 1, 2)
        out[:, 2 * n:, 2 * n:] = self._corner
        return out

    def variances(self) -> Floats:
        """Return the variance of each unknown of each block: (N, n)."""
        return _diagonals(self._diagonal)

    def next_covariances(self) -> Floats:
        """Return the covariance of each unknown with itself in the next block: (N - 1, n)."""
        return _diagonals(self._cross[:-1, :, :self._diagonal.shape[1]])

    def variances_of(self, rows: Ints, J: Floats, J_constants: Floats, J_next: Floats | None,
                     next_columns: slice) -> Floats:
        """
        Return the variances of linear functions of the unknowns of some intervals: (k, c).

        J, J_constants : (k, n, c), (k, m, c) derivatives by block and constants.   J_next :
        (k, a, c) by the unknowns ``next_columns`` of the next block, or None.
        """
        n, cross = J.shape[1], self._cross[rows]
        by_block = self._diagonal[rows] @ J + 2 * (cross[:, :, n:] @ J_constants)
        by_constants = self._corner @ J_constants
        if J_next is not None:
            by_block += 2 * (cross[:, :, :n][:, :, next_columns] @ J_next)
            by_next = self._diagonal[rows + 1, next_columns, next_columns] @ J_next
            by_next += 2 * (self._cross[rows + 1, next_columns, n:] @ J_constants)
        out: Floats = (J * by_block).sum(axis=1) + (J_constants * by_constants).sum(axis=1)
        return out if J_next is None else out + (J_next * by_next).sum(axis=1)

    def covariance_form(self, rows: slice, J: Floats) -> Floats:
        """
        Return matrices A of some intervals, (k, r, r): a' A a is the variance of a' J x.

        x : the unknowns of an interval.   J : (k, r, 2n + m).   A is not symmetric, which saves
        half of the products.
        """
        n, ends = self._diagonal.shape[1], slice(rows.start + 1, rows.stop + 1)
        cross, after = self._cross[rows], self._cross[ends][:, :, n:]
        begin, end, constants = J[:, :, :n], J[:, :, n:2 * n], J[:, :, 2 * n:]
        by_begin = begin @ self._diagonal[rows] + 2 * (end @ np.swapaxes(cross[:, :, :n], 1, 2))
        by_constants = 2 * (begin @ cross[:, :, n:] + end @ after) + constants @ self._corner
        out: Floats = by_begin @ np.swapaxes(begin, 1, 2)
        out += by_constants @ np.swapaxes(constants, 1, 2)
        out += end @ self._diagonal[ends] @ np.swapaxes(end, 1, 2)
        return out

    def blocks(self) -> Iterator[Floats]:
        """Yield the covariances of all intervals in chunks: (k, 2n + m, 2n + m)."""
        for rows in blocks(len(self)):
            yield self.covariances(np.arange(rows.start, rows.stop))


def solve(normal: NormalEquations) -> Solution:
    """Solve normal equations in place; raises NotPositive if an unknown is not constrained."""
    right_sides, (N, n), m = normal.right_sides, normal.g.shape, len(normal.g_constants)
    s, s_c = _scale(normal)
    corner, s_corner = np.zeros((m + 1, m + 1)), np.multiply.outer(s_c, s_c)
    corner[:m, :m], corner[:m, m] = normal.corner * s_corner, normal.g_constants * s_c
    corner[m, :m] = corner[:m, m]
    roots = _eliminate(normal, corner)
    root, info = dpotrf(corner[:m, :m], lower=1)
    if info:
        raise NotPositive('the data do not determine the constants of the vehicle')
    logdet = 2 * sum(np.log(x).sum() for x in (roots / s, root.diagonal() / s_c)) \
        + np.log(normal.unused_weights).sum()
    reduced = (corner[:m, :m] + corner[:m, :m].T) / 2 / s_corner
    c = dpotrs(root, corner[:m, m], lower=1)[0].ravel()
    covariance = dpotrs(root, np.eye(m), lower=1)[0]
    x = np.concatenate([right_sides[rows, :, n + m] - right_sides[rows, :, n:n + m] @ c
                        for rows in blocks(N)])
    for k in iterate_releasing(range(N - 2, -1, -1)):
        x[k] -= right_sides[k][:, :n] @ x[k + 1]
    unused = normal.unused_weights
    return Solution(
        x * s, _with_unused(c * s_c, 0 * unused),
        _with_unused(covariance * s_corner, 1 / unused), float(logdet),
        _with_unused(reduced, unused), _with_unused(corner[:m, m] / s_c, 0 * unused),
        (right_sides, normal.diagonal), s, s_c)


def _scale(normal: NormalEquations) -> tuple[Floats, Floats]:
    """Scale the blocks to a unit diagonal, in place; return the factors: (N, n), (m,)."""
    diagonal, right_sides = normal.diagonal, normal.right_sides
    N, n = normal.g.shape
    s = np.ones((N + 1, n))     # of N blocks and of one after the last, which is not used
    for rows in blocks(N):
        s[rows] = 1 / np.sqrt(np.maximum(np.einsum('kii->ki', diagonal[rows]), 1e-300))
    s_c: Floats = 1 / np.sqrt(np.maximum(np.diag(normal.corner), 1e-300))
    for rows in blocks(N):
        diagonal[rows] *= s[rows, :, None]
        diagonal[rows] *= s[rows, None, :]
        right_sides[rows] *= s[rows, :, None]
        right_sides[rows, :, :n] *= s[rows.start + 1:rows.stop + 1, None, :]
        normal.coupling[rows] *= s_c
    return s[:N], s_c


def _eliminate(normal: NormalEquations, corner: Floats) -> Floats:
    """
    Eliminate the blocks, in place; return the diagonals of their Cholesky factors: (N, n).

    corner : (m + 1, m + 1), reduced; the last row and column are those of the right-hand side.
    """
    diagonal, right_sides = normal.diagonal, normal.right_sides
    N, n = normal.g.shape
    D, roots = diagonal[0], np.empty((N, n))
    for k in iterate_releasing(range(N)):
        root, info = dpotrf(D, lower=1)
        if info:
            raise NotPositive(f'the data do not determine block {k} of {N}', k)
        W = right_sides[k]
        X, _ = dpotrs(root, W, lower=1)
        roots[k] = root.diagonal()
        corner -= W[:, n:].T @ X[:, n:]
        if k + 1 < N:
            fill_in = W[:, :n].T @ X
            D = diagonal[k + 1] - fill_in[:, :n]
            right_sides[k + 1, :, n:] -= fill_in[:, n:]
        diagonal[k] = dpotri(root, lower=1)[0]
        W[:] = X
    below = np.tril_indices(n, -1)      # dpotri fills one triangle
    for rows in blocks(N):
        diagonal[rows, below[1], below[0]] = diagonal[rows, below[0], below[1]]
    return roots


def _diagonals(matrices: Floats) -> Floats:
    """Return the diagonals of matrices (k, n, n): (k, n)."""
    # copies: views would be read again after their memory is released
    return np.concatenate([np.einsum('kii->ki', matrices[rows]).copy()
                           for rows in blocks(len(matrices))])


def _with_unused(x: Floats, unused: Floats) -> Floats:
    """Return a vector, or a matrix by its diagonal, with the unused constants: (m,), (m, m)."""
    if x.ndim == 1:
        return np.concatenate([x, unused])
    out = np.diag(np.concatenate([np.zeros(len(x)), unused]))
    out[:len(x), :len(x)] = x
    return out
