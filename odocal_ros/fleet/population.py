# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The vehicles of a model beside each other: robust mean and spread, and who lies outside."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.nav.statistics import NORMAL_MEDIAN

Floats = NDArray[np.float64]
FAR = 4.0            # statistical: sigmas of a vehicle from its model: by chance one in 16,000
LEAST = 3            # judgement: vehicles needed for a spread


@dataclass(frozen=True, eq=False)
class Population:
    """
    Values of one model's vehicles.

    mean, sigma : robust, and how well it is known.   spread : between vehicles, beyond their
    sigmas, 1 sigma.   deviates : (n,) of each vehicle, in sigmas of spread and its own together;
    nan of too few vehicles.
    """

    mean: float
    sigma: float
    spread: float
    deviates: Floats

    @property
    def outliers(self) -> NDArray[np.intp]:
        """Return the numbers of those who lie outside."""
        return np.flatnonzero(np.abs(self.deviates) > FAR)


def population(values: Floats, sigmas: Floats) -> Population:
    """
    Return the population of vehicles, values (n,) with their sigmas.

    The spread is that with which half of all lie as near to the mean as the normal law says; the
    mean is Huber's, so that a vehicle far off moves neither.
    """
    x, s = np.asarray(values, float), np.asarray(sigmas, float)
    mean, spread = float(np.median(x)), 0.0
    if len(x) < LEAST:
        return Population(mean, float(s.max()), 0.0, np.full(len(x), np.nan))
    huber = 1.5    # sigmas from which a vehicle counts for less
    passes = 50
    for _ in range(passes):
        before = mean
        spread = _spread(np.abs(x - mean), s)
        total = np.hypot(s, max(spread, 1e-300))
        weight = np.minimum(1.0, huber * total / np.maximum(np.abs(x - mean), 1e-300)) / total**2
        mean = float(weight @ x / weight.sum())
        if abs(mean - before) <= 1e-12 * max(float(total.min()), 1e-300):
            break
    return Population(mean, float(weight.sum()**-0.5), spread, (x - mean) / total)


def _spread(off: Floats, s: Floats) -> float:
    """Return the spread at which the median of off / sigma is that of the normal law."""
    if np.median(off / np.maximum(s, 1e-300)) <= NORMAL_MEDIAN:
        return 0.0
    low, high = 0.0, float(off.max()) / NORMAL_MEDIAN
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if np.median(off / np.hypot(s, middle)) > NORMAL_MEDIAN else (
            low, middle)
    return high
