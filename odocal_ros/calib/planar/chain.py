# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Linear least squares for a chain of nodes with constants common to all of them.

Each residual depends on the s states of a node, those of the next node, and m constants. The
normal equations of the states are block tridiagonal and solved by a banded Cholesky; the constants
are solved for first, by the Schur complement. Residuals are grouped by noise level, an unknown
variance factor: ``Equations`` are those of one level with factor 1, ``Solution`` weights them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Linearised residuals of one noise level, in n groups of q, each at a node k.

    They are value + by_state dx_k + by_next dx_(k+1) + by_constants dc.
    """

    node: Ints            # (n,) k
    value: Floats         # (n, q)
    by_state: Floats      # (n, q, s) derivatives
    by_next: Floats       # (n, q, s)
    by_constants: Floats  # (n, q, m)
    weight: Floats        # (n, q) one over the variance if the level is 1

    @property
    def count(self) -> int:
        """Return the number of rows."""
        return self.value.size

    def square(self) -> float:
        """Return the weighted sum of squared residuals."""
        return float((self.weight * self.value**2).sum())


class Equations:
    """
    Normal equations of the rows of one noise level, as if it were 1, for N nodes.

    Of the states: blocks ``diagonal`` and ``off_diagonal``, (N, s, s), ``gradient``, (N, s), and
    the product with the constants, ``cross``, (N, s, m). Of the constants:
    ``constants_information``, (m, m), and ``constants_gradient``, (m,).
    """

    def __init__(self, rows: Rows, nodes: int) -> None:
        A, B, C, w, k = rows.by_state, rows.by_next, rows.by_constants, rows.weight, rows.node
        s, m = A.shape[2], C.shape[2]

        def product(X: Floats, Y: Floats) -> Floats:
            return np.swapaxes(X * w[:, :, None], 1, 2) @ Y
        r = rows.value[:, :, None]
        # ``by_next`` of the last node is zero; it goes to an extra node that is removed below
        self.diagonal, self.off_diagonal = np.zeros((2, nodes + 1, s, s))
        self.cross, self.gradient = np.zeros((nodes + 1, s, m)), np.zeros((nodes + 1, s))
        # += adds once for equal indices, but the rows of a level have different nodes
        for node, X in ((k, A), (k + 1, B)):
            self.diagonal[node] += product(X, X)
            self.cross[node] += product(X, C)
            self.gradient[node] += product(X, r)[:, :, 0]
        self.off_diagonal[k] += product(A, B)
        self.diagonal, self.off_diagonal, self.cross, self.gradient = (
            x[:nodes] for x in (self.diagonal, self.off_diagonal, self.cross, self.gradient))
        self.constants_information = product(C, C).sum(0)
        self.constants_gradient = product(C, r).sum((0, 2))


class Solution:
    """Solution of the weighted sum of equations: steps of the states (N, s) and constants (m,)."""

    def __init__(self, equations: list[Equations], weight: Floats, prior: Floats,
                 prior_gradient: Floats) -> None:
        """Solve; weight : 1 / level of each of the equations; prior : information, (m, m)."""
        def weighted_sum(name: str) -> Floats:
            return np.asarray(sum(w * getattr(level, name)
                                  for w, level in zip(weight, equations, strict=True)))
        n, s = weighted_sum('gradient').shape
        self._band = cholesky_banded(_banded(
            weighted_sum('diagonal'), weighted_sum('off_diagonal')))
        B, g = weighted_sum('cross').reshape(n * s, -1), weighted_sum('gradient').ravel()
        X = cho_solve_banded((self._band, False), np.column_stack([B, g]))
        # not by BLAS: its sums depend on the number of threads and on the place in memory
        schur = np.einsum('ki,kj->ij', B, X)
        self.information = weighted_sum('constants_information') + prior - schur[:, :-1]
        self._root = cho_factor(self.information, lower=True)
        self.constants = cho_solve(
            self._root, -(weighted_sum('constants_gradient') + prior_gradient) + schur[:, -1])
        self.states = (-X[:, -1] - np.einsum('ij,j->i', X[:, :-1], self.constants)).reshape(n, s)

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the constants: (m, m)."""
        inverse: Floats = cho_solve(self._root, np.eye(len(self.constants)))
        return (inverse + inverse.T) / 2

    def log_determinant(self) -> float:
        """Return the log determinant of the matrix of all equations."""
        # a copy: the last bits of logarithms of a strided array depend on its place in memory
        states_part = np.log(self._band[-1].copy()).sum()
        return float(2 * (states_part + np.log(np.diag(self._root[0])).sum()))


def _banded(diagonal: Floats, off_diagonal: Floats) -> Floats:
    """Return the upper band of a block tridiagonal matrix, as LAPACK stores it: (2 s, n s)."""
    n, s, _ = diagonal.shape
    band = np.zeros((2 * s, n, s))
    for i in range(s):
        for j in range(s):
            if j >= i:
                band[2 * s - 1 + i - j, :, j] = diagonal[:, i, j]
            band[s - 1 + i - j, 1:, j] = off_diagonal[:-1, i, j]
    return band.reshape(2 * s, n * s)
