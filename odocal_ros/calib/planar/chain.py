# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Normal equations of a chain of nodes with common constants, solved by a banded Cholesky."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Rows:
    """Residual rows of one noise level: r = value + here dx_k + ahead dx_(k+1) + constant dc."""

    node: Ints        # (n,) node k of each group of rows
    value: Floats     # (n, q)
    here: Floats      # (n, q, s) derivatives by the state of node k
    ahead: Floats     # (n, q, s) by that of node k + 1
    constant: Floats  # (n, q, m) by the constants
    weight: Floats    # (n, q) one over the variance at level 1

    @property
    def count(self) -> int:
        """Return the number of rows."""
        return self.value.size

    def square(self) -> float:
        """Return the weighted sum of squared residuals."""
        return float((self.weight * self.value**2).sum())


class Equations:
    """Normal equations of the rows of one noise level, at level 1: blocks, border, gradient."""

    def __init__(self, rows: Rows, nodes: int) -> None:
        A, B, C, w, k = rows.here, rows.ahead, rows.constant, rows.weight, rows.node
        s, m = A.shape[2], C.shape[2]

        def product(X: Floats, Y: Floats) -> Floats:
            return np.swapaxes(X * w[:, :, None], 1, 2) @ Y
        v = rows.value[:, :, None]
        # rows of the last node have zeros ahead, for an extra node, removed below; nodes differ
        self.diagonal, self.off = np.zeros((2, nodes + 1, s, s))
        self.border, self.gradient = np.zeros((nodes + 1, s, m)), np.zeros((nodes + 1, s))
        for at, X in ((k, A), (k + 1, B)):
            self.diagonal[at] += product(X, X)
            self.border[at] += product(X, C)
            self.gradient[at] += product(X, v)[:, :, 0]
        self.off[k] += product(A, B)
        self.diagonal, self.off, self.border, self.gradient = (
            x[:nodes] for x in (self.diagonal, self.off, self.border, self.gradient))
        self.constant, self.slope = product(C, C).sum(0), product(C, v).sum((0, 2))


class Solved:
    """The weighted sum of equations, factorised; step (n, s), constants (m,), log determinant."""

    def __init__(self, parts: list[Equations], weight: Floats, prior: Floats,
                 slope: Floats) -> None:
        """Take the equations and 1 / level of each; prior (m, m) and slope (m,) of constants."""
        def whole(name: str) -> Floats:
            out: Floats = sum(w * getattr(p, name) for w, p in zip(weight, parts, strict=True))
            return out
        n, s = whole('gradient').shape
        self._band = cholesky_banded(_banded(whole('diagonal'), whole('off')))
        B, g = whole('border').reshape(n * s, -1), whole('gradient').ravel()
        X = cho_solve_banded((self._band, False), np.column_stack([B, g]))
        # not by BLAS: its sums depend on the number of threads and on the place in memory
        taken = np.einsum('ki,kj->ij', B, X)
        self.information = whole('constant') + prior - taken[:, :-1]
        self._root = cho_factor(self.information, lower=True)
        self.constants = cho_solve(self._root, -(whole('slope') + slope) + taken[:, -1])
        self.step = (-X[:, -1] - np.einsum('ij,j->i', X[:, :-1], self.constants)).reshape(n, s)

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the constants: (m, m)."""
        out: Floats = cho_solve(self._root, np.eye(len(self.constants)))
        return (out + out.T) / 2

    def log_determinant(self) -> float:
        """Return the log determinant of all equations."""
        # a copy: the last bits of logarithms of a strided array depend on its place in memory
        own = np.log(self._band[-1].copy()).sum()
        return float(2 * (own + np.log(np.diag(self._root[0])).sum()))


def _banded(diagonal: Floats, off: Floats) -> Floats:
    """Return the upper band of a block tridiagonal matrix: (2 s, n s)."""
    n, s, _ = diagonal.shape
    band = np.zeros((2 * s, n, s))
    for i in range(s):
        for j in range(s):
            if j >= i:
                band[2 * s - 1 + i - j, :, j] = diagonal[:, i, j]
            band[s - 1 + i - j, 1:, j] = off[:-1, i, j]
    return band.reshape(2 * s, n * s)
