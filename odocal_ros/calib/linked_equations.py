# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The normal equations of several legs, solved by eigenvalues: docs/method.md (S35), (S36)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from odocal_ros.data.arrays import Floats, Ints

# statistical: of eigenvalues to the largest: errors of doubles, times the loss by elimination
LEG_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class LinkedEquations:
    """Normal equations H x = g of linked legs; see ``LinkedLegs.equations``."""

    H: Floats
    g: Floats
    cost: float                          # of the rows at x = 0
    prior: tuple[Floats, Floats, float]  # diagonal of H, g and cost by priors
    others: int                          # number of constants that do not drift
    rows: int                            # number of rows of legs and random walk

    @cached_property
    def _parts(self) -> tuple[Floats, Floats, Floats]:
        """Return eigenvalues of H with a unit diagonal, its eigenvectors, and the scale."""
        s = 1 / np.sqrt(np.maximum(np.diag(self.H), LEG_ROUNDING))
        size, V = np.linalg.eigh(self.H * np.multiply.outer(s, s))
        return size, V * s[:, None], s

    @property
    def log_determinant(self) -> float:
        """Return the log determinant of H."""
        size, _, s = self._parts
        return float(np.log(np.maximum(size, LEG_ROUNDING)).sum() - 2 * np.log(s).sum())

    def least_cost(self) -> float:
        """Return the weighted sum of squares at the solution."""
        size, V, _ = self._parts
        return self.cost - float(((self.g @ V)**2) @ (1 / np.maximum(size, LEG_ROUNDING)))

    def misfit(self) -> tuple[float, float]:
        """Return the chi-square of legs and random walk, and its degrees of freedom."""
        size, V, _ = self._parts
        size, V = size[size > LEG_ROUNDING], V[:, size > LEG_ROUNDING]
        x = V @ (self.g @ V / size)
        weight, pull, at_zero = self.prior
        of_prior = x @ (weight * x - 2 * pull) + at_zero
        fitted = len(size) - float((weight @ V**2) @ (1 / size))
        return self.cost - float(self.g @ x + of_prior), self.rows - fitted

    def solved(self) -> tuple[Floats, Floats]:
        """Return the solution and its covariance, of each leg its own drifting constant."""
        size, V, _ = self._parts
        V = V.copy()
        V[self.others:] = np.cumsum(V[self.others:][::-1], axis=0)[::-1]
        size = np.maximum(size, LEG_ROUNDING)
        return V @ (self.g @ self._parts[1] / size), V / size @ V.T

    def of(self, keep: Ints) -> tuple[Floats, Floats]:
        """Return H and g of some unknowns, the others eliminated."""
        gone = np.setdiff1d(np.arange(len(self.g)), keep)
        if not len(gone):
            return self.H[np.ix_(keep, keep)], self.g[keep]
        taken = np.linalg.solve(self.H[np.ix_(gone, gone)], self.H[np.ix_(gone, keep)]).T
        D = self.H[np.ix_(keep, keep)] - taken @ self.H[np.ix_(gone, keep)]
        return (D + D.T) / 2, self.g[keep] - taken @ self.g[gone]
