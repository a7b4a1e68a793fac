# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Speeds that are repeated until they have changed by a step, as on many buses.

The value after a change is correct. Until the next change the speed is within one step of it, in
the direction of the change: half a step is added, and the error is uniform over the step, not
noise. Zeros are used unchanged: at standstill the vehicle does not move.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.coarse_speed import CoarseSpeed, LEAST_CROSSING, SpeedInstants

# judgement: minimum share of moving rows that repeat the one before
HELD_SHARE = 0.3
# statistical: changes needed to estimate a step. If changes have any size, the smallest of 50 is a
# fifth of their tenth percentile; if speeds are held, both are one step plus the change in one row
FEWEST_CHANGES, LEAST_OVER_TENTH = 50, 0.6


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldSpeed(CoarseSpeed):
    """A speed held until it has changed by ``step``; ``value``: centre of its interval."""

    sent: Floats             # (n,) as published

    @property
    def truncation(self) -> float:
        """Return the common error of all values by truncation: 0."""
        return 0.0

    def mirrored(self, sign: Floats) -> 'HeldSpeed':
        """Return the speed times signs (n,)."""
        return replace(self, value=self.value * sign, sent=self.sent * sign)

    @cached_property
    def instants(self) -> SpeedInstants:
        """Return the speeds at changes, which are correct except for sampling."""
        v = self.sent
        row = np.flatnonzero((np.diff(v, prepend=v[:1]) != 0) & (v != 0))
        sigma = np.full(len(row), LEAST_CROSSING * self.step)
        return SpeedInstants(self.t[row], v[row], np.sign(v[row]), sigma)


def held_speed(t: Floats, value: Floats) -> HeldSpeed | None:
    """Return the held speed from rows (n,); None if the speed is not held."""
    change = np.diff(value)
    size = np.abs(change[(value[1:] != 0) & (value[:-1] != 0)])
    changes = size[size > 0]
    if len(changes) < FEWEST_CHANGES or len(changes) > (1 - HELD_SHARE) * len(size):
        return None
    step = float(changes.min())
    if step < LEAST_OVER_TENTH * np.percentile(changes, 10):
        return None
    last = np.maximum.accumulate(np.where(change != 0, np.arange(1, len(value)), 0))
    side = np.append(0.0, np.sign(change)[np.maximum(last - 1, 0)])
    middle = np.where(value == 0, 0.0, value + side * step / 2)
    return HeldSpeed(step, t, middle, sent=value)
