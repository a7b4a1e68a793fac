# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Linear least squares for a chain of nodes with constants common to all of them.

Each residual depends on the s states of a node, those of the next node, and m constants. The
normal equations of the states are block tridiagonal and solved by a banded Cholesky; the constants
are solved for first, by the Schur complement. Residuals are grouped by noise level, an estimated
variance: ``normal_equations`` are those of one level as if it were 1, ``weighted_sum`` joins them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from odocal_ros.data.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Linearised residuals of one noise level, in n groups of q, each at a node k.

    They are value + by_state dx_k + by_next dx_(k+1) + by_constants dc.
    """

    node: Ints            # (n,) k, each at most once
    value: Floats         # (n, q)
    by_state: Floats      # (n, q, s) derivatives
    by_next: Floats       # (n, q, s)
    by_constants: Floats  # (n, q, m)
    weight: Floats        # (n, q) one over the variance if the level is 1

    @property
    def count(self) -> int:
        """Return the number of rows."""
        return self.value.size

    def weighted_square_sum(self) -> float:
        """Return the weighted sum of squared residuals."""
        return float((self.weight * self.value**2).sum())


class Equations(NamedTuple):
    """Normal equations of N nodes with s states each, and m constants."""

    diagonal: Floats                # (N, s, s) blocks of the states
    off_diagonal: Floats            # (N, s, s) blocks of a node and the next one; last zero
    cross: Floats                   # (N, s, m) of states and constants
    gradient: Floats                # (N, s)
    constants_information: Floats   # (m, m)
    constants_gradient: Floats      # (m,)


def normal_equations(rows: Rows, nodes: int) -> Equations:
    """Return the equations of the rows of one noise level, as if it were 1."""
    by_state, by_next, by_constants, k = rows.by_state, rows.by_next, rows.by_constants, rows.node
    s, m = by_state.shape[2], by_constants.shape[2]

    def product(X: Floats, Y: Floats) -> Floats:
        """Return X' W Y of each group, with the weights W of the rows."""
        return np.swapaxes(X * rows.weight[:, :, None], 1, 2) @ Y
    r = rows.value[:, :, None]
    # ``by_next`` of the last node is zero; it goes to an extra node that is removed below
    diagonal, off_diagonal = np.zeros((2, nodes + 1, s, s))
    cross, gradient = np.zeros((nodes + 1, s, m)), np.zeros((nodes + 1, s))
    for node, derivatives in ((k, by_state), (k + 1, by_next)):
        diagonal[node] += product(derivatives, derivatives)
        cross[node] += product(derivatives, by_constants)
        gradient[node] += product(derivatives, r)[:, :, 0]
    off_diagonal[k] += product(by_state, by_next)
    return Equations(diagonal[:nodes], off_diagonal[:nodes], cross[:nodes], gradient[:nodes],
                     product(by_constants, by_constants).sum(0),
                     product(by_constants, r).sum((0, 2)))


def weighted_sum(equations: Iterable[Equations], weight: Floats) -> Equations:
    """Return the equations of all levels; weight : 1 / level of each of the equations."""
    return Equations(*(np.asarray(sum(w * x for w, x in zip(weight, of_levels, strict=True)))
                       for of_levels in zip(*equations, strict=True)))


class Solution:
    """Solution of equations: steps of the states (N, s) and constants (m,)."""

    def __init__(self, equations: Equations, prior: Floats, prior_gradient: Floats) -> None:
        """
        Solve the equations.

        prior : information of the constants, (m, m).   prior_gradient : (m,) this times the
        deviation of the constants from their prior values.
        """
        n, s = equations.gradient.shape
        self._band = cholesky_banded(_banded(equations.diagonal, equations.off_diagonal))
        B, g = equations.cross.reshape(n * s, -1), equations.gradient.ravel()
        X = cho_solve_banded((self._band, False), np.column_stack([B, g]))
        # not by BLAS: its sums depend on the number of threads and on the place in memory
        schur = np.einsum('ki,kj->ij', B, X)
        self.information = equations.constants_information + prior - schur[:, :-1]
        self._root = cho_factor(self.information, lower=True)
        self.constants = cho_solve(
            self._root, -(equations.constants_gradient + prior_gradient) + schur[:, -1])
        self.states = (-X[:, -1] - np.einsum('ij,j->i', X[:, :-1], self.constants)).reshape(n, s)

    @property
    def covariance(self) -> Floats:
        """Return the covariance of the constants: (m, m)."""
        inverse: Floats = cho_solve(self._root, np.eye(len(self.constants)))
        return (inverse + inverse.T) / 2

    @property
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
