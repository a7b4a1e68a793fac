# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""
Average information of the noise levels, and the uncertainty they add: docs/method.md (S27b).

V_i is the derivative of the covariance R of all rows by the logarithm of level i, u = R^-1 r the
weighted residuals. With q_i = V_i u and g_i = J' R^-1 q_i, Gilmour, Thompson and Cullis (1995):

    A_ij = (q_i' R^-1 q_j - g_i' H^-1 g_j) / 2,        dc / d(ln level_i) = (H^-1 g_i) of constants
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.mapped import room


class LevelSides:
    """
    The right-hand sides of L levels, at first all zero.

    names : of the levels.   chain : (N, n, L) g_i by the keyframes.   border : (m, L) by the
    constants.   square : (L, L) q_i' R^-1 q_j.
    """

    def __init__(self, N: int, n: int, m: int, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self.chain = room(N, n, len(self.names))
        self.border = np.zeros((m, len(self.names)))
        self.square = np.zeros((len(self.names),) * 2)

    def at(self, names: Iterable[str]) -> list[int]:
        """Return the columns of some levels."""
        return [self.names.index(name) for name in names]


@dataclass(frozen=True, eq=False)
class LevelInformation:
    """
    Information of the data on the levels, and the effect of the levels on the constants.

    names : of the L levels.   average : (L, L) information on their logarithms.   moves : (m, L)
    derivatives of the constants by these logarithms.
    """

    names: tuple[str, ...]
    average: Floats
    moves: Floats

    def effects(self, precision: Mapping[str, float]) -> Floats:
        """
        Return the effects of independent unit errors of the levels on the constants: (m, L).

        A column is the error of its level that is independent of the levels before it.

        precision : information of the prior on each logarithm, by the name of the level.
        """
        own = np.diag([precision[name] for name in self.names])
        root = np.linalg.cholesky(np.linalg.inv(self.average + own))
        return self.moves @ root
