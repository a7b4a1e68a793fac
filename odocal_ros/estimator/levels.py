# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise levels: the variance components of a fit, docs/method.md (S26)."""

from dataclasses import dataclass

import numpy as np

SLOW_LEVELS = ('slow', 'slow_up')


@dataclass(frozen=True)
class Levels:
    """
    Variance of each component: per s of INTERVAL and slow errors, factors on the stated ones.

    ``correlation_time`` is one of them: of the correlated fix error, s, if it is estimated.
    """

    values: dict[str, float]

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    @property
    def correlation_time(self) -> float:
        """Return the correlation time of the correlated fix error, s, 0: none."""
        return self.values.get('correlation_time', 0.0)

    def but(self, **values: float) -> 'Levels':
        """Return levels with some values replaced."""
        return Levels(self.values | values)

    def roots(self) -> dict[str, float]:
        """Return standard deviations, stationary ones of correlated errors, and the time."""
        time = self.correlation_time
        return {k: float(np.sqrt(v * (time / 2 if k in SLOW_LEVELS else 1.0)))
                for k, v in self.values.items()} | {'correlation_time': time}

    @classmethod
    def of_roots(cls, roots: dict[str, float]) -> 'Levels':
        """Return the levels with these standard deviations."""
        time = roots['correlation_time']
        return cls({k: v**2 / (time / 2 if time and k in SLOW_LEVELS else 1.0)
                    for k, v in roots.items()} | {'correlation_time': time})
