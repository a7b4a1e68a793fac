# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Noise levels: the variances that a fit estimates, docs/method.md (S26).

Their uncertainty follows from the average information (S27b) of Gilmour, Thompson and Cullis
(1995). V_i is the derivative of the covariance R of all rows by the logarithm of level i, and
R^-1 r are the weighted residuals. With q_i = V_i R^-1 r and g_i = J' R^-1 q_i,

    A_ij = (q_i' R^-1 q_j - g_i' H^-1 g_j) / 2,        dc / d(ln level_i) = (H^-1 g_i) of constants
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats, work_array

# of the time-correlated fix error, horizontal and vertical: spectral densities of its noise, m^2/s
CORRELATED_LEVELS = ('slow', 'slow_up')


@dataclass(frozen=True)
class Levels:
    """
    The noise levels by name.

    IMU and road noise (factors/interval_noise.py) and the time-correlated fix error: variance per
    second. A sensor with stated sigmas: factor on its variances. 'size_...': factor on the
    usual variance of an imperfection, (S28). 'correlation_time': of the fix error, s.
    """

    values: dict[str, float]

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    @property
    def correlation_time(self) -> float:
        """Return the correlation time of the correlated fix error, s, 0: none."""
        return self.values.get('correlation_time', 0.0)

    def replaced(self, **values: float) -> 'Levels':
        """Return levels with some values replaced."""
        return Levels(self.values | values)

    def sigmas(self) -> dict[str, float]:
        """
        Return the square roots of the levels.

        Of the correlated fix error it is the stationary sigma; the correlation time stays in s.
        """
        time = self.correlation_time
        return {k: float(np.sqrt(v * (time / 2 if k in CORRELATED_LEVELS else 1.0)))
                for k, v in self.values.items()} | {'correlation_time': time}

    @classmethod
    def from_sigmas(cls, sigmas: dict[str, float]) -> 'Levels':
        """Return the levels with these sigmas, as ``sigmas`` returns them."""
        time = sigmas['correlation_time']
        return cls({k: v**2 / (time / 2 if time and k in CORRELATED_LEVELS else 1.0)
                    for k, v in sigmas.items()} | {'correlation_time': time})


class LevelRightHandSides:
    """
    The right-hand sides of L levels, summed over the factors.

    g : (N, n, L) rows of the keyframes of g_i.   g_constants : (m, L) rows of the constants.
    q_products : (L, L) q_i' R^-1 q_j.
    """

    def __init__(self, N: int, n: int, m: int, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self.g = work_array(N, n, len(self.names))
        self.g_constants = np.zeros((m, len(self.names)))
        self.q_products = np.zeros((len(self.names),) * 2)

    def columns(self, names: Iterable[str]) -> list[int]:
        """Return the columns of some levels."""
        return [self.names.index(name) for name in names]


@dataclass(frozen=True, eq=False)
class LevelInformation:
    """Information of the data on L levels, and the effect of the levels on the constants."""

    names: tuple[str, ...]
    average: Floats     # (L, L) information on the logarithms of the levels, A of (S27b)
    constants_by_level: Floats      # (m, L) derivatives of the constants by these logarithms, W

    def effects(self, precision: Mapping[str, float]) -> Floats:
        """
        Return the effects of independent unit errors of the levels on the constants: (m, L).

        A column is the error of its level that is independent of the levels before it.

        precision : information of the prior on each logarithm, by the name of the level.
        """
        prior = np.diag([precision[name] for name in self.names])
        return self.constants_by_level @ np.linalg.cholesky(np.linalg.inv(self.average + prior))
