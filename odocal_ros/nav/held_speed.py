# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Speeds that a sender holds until they have changed by a step, as many buses do to save messages.

A value after a change is right. Until the next one the speed lies within a step beyond it, on the
side that it changed to: half a step is taken for it, and its error, that of a cell, is no noise.
Zeros are taken as they are, for a vehicle that stands is not held in motion.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.coarse_speed import CoarseSpeed, LEAST_CROSSING, SpeedInstants

# judgement: of the rows that move, those that repeat the one before, at least
HELD_SHARE = 0.3
# statistical: changes to know a step by. Of speeds that change by anything the least of 50 is a
# fifth of their tenth percentile; of held ones both are a step and what the speed gains in a row
FEWEST_CHANGES, LEAST_OVER_TENTH = 50, 0.6


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldSpeed(CoarseSpeed):
    """A speed held until it has changed by ``step``; ``value``: the middle of where it may be."""

    sent: Floats             # (n,) as it was sent

    @property
    def truncation(self) -> float:
        """Return by how much all values may be too small: not at all."""
        return 0.0

    def mirrored(self, sign: Floats) -> 'HeldSpeed':
        """Return the speed with signs (n,) of its own."""
        return replace(self, value=self.value * sign, sent=self.sent * sign)

    @cached_property
    def instants(self) -> SpeedInstants:
        """Return the speeds at changes, which are right but for how they are sampled."""
        v = self.sent
        row = np.flatnonzero((np.diff(v, prepend=v[:1]) != 0) & (v != 0))
        sigma = np.full(len(row), LEAST_CROSSING * self.step)
        return SpeedInstants(self.t[row], v[row], np.sign(v[row]), sigma)


def held_speed(t: Floats, value: Floats) -> HeldSpeed | None:
    """Return the speed of a sender that holds it, by its rows (n,); None if it does not."""
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
