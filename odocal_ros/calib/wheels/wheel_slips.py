# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detected slips of the wheels, and the reason that reports them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.reasons import Code, Reason

# s, judgement: between rows in the search for slips, which last a second or more
SLIP_GRID = 0.1


def _none(kind: type = float) -> NDArray[Any]:
    return field(default_factory=lambda: np.empty(0, kind))


@dataclass(frozen=True, eq=False)
class WheelSlips:
    """Slips of single wheels, in order of time: (k,)."""

    begin: Floats = _none()        # s
    end: Floats = _none()          # s
    size: Floats = _none()         # m, > 0: farther; unknown wheel: right minus left
    wheel: Ints = _none(np.int64)  # -1 left, +1 right, 0 unknown
    change: float = 0.0            # of the ratio right over left in the drive, as if at half of it
    count: int = 2                 # number of wheels in the mean

    @property
    def t(self) -> Floats:
        """Return the middle of each slip, s."""
        return (self.begin + self.end) / 2

    def doubts(self) -> tuple[Floats, Floats]:
        """
        Return the times at which the mean of the wheels is uncertain, and its sigma: (d,) s, m.

        A slip of one of ``count`` wheels is 1 / ``count`` as large in the mean, distributed over
        its seconds.
        """
        seconds = np.maximum(np.ceil(self.end - self.begin), 1.0).astype(int)
        t = [begin + (end - begin) * (np.arange(n) + 0.5) / n
             for begin, end, n in zip(self.begin, self.end, seconds, strict=True)]
        sigma = np.repeat(np.abs(self.size) / self.count / np.sqrt(seconds), seconds)
        return np.concatenate([*t, []]), sigma


NO_SLIPS = WheelSlips()


def of_axles(axles: Sequence[WheelSlips], count: int) -> WheelSlips:
    """Return the slips of the wheels of several axles; count: number of wheels in the mean."""
    columns = {name: np.concatenate([getattr(one, name) for one in axles]) for name in (
        'begin', 'end', 'size', 'wheel')}
    order = np.argsort(columns['begin'], kind='stable')
    return WheelSlips(**{name: column[order] for name, column in columns.items()},
                      change=math.hypot(*(one.change for one in axles)), count=count)


def slips_of(events: list[tuple[float, float, float]], wheel: list[int]) -> WheelSlips:
    """Return slips by (begin s, end s, size m, right minus left) and by wheel, -1, 0 or +1."""
    begin, end, size = np.array(events).T
    which = np.array(wheel, np.int64)
    # if the left wheel spins, right minus left is negative
    return WheelSlips(begin, end, np.where(which < 0, -size, size), which)


def slip_reason(slips: WheelSlips, names: tuple[str, ...]) -> tuple[Reason]:
    """Return the reason that names the wheel with the largest slip, its size and time."""
    n = len(slips.size)
    worst = int(np.argmax(np.abs(slips.size)))
    left, right = (f'the {name} wheel' for name in names)
    which = ('one of the wheels', right, left)[slips.wheel[worst]]
    done = 'deviates' if not slips.wheel[worst] else 'spins' if slips.size[worst] > 0 else 'slides'
    other = ' from the other' * (not slips.wheel[worst])
    return (Reason(Code.WHEEL_SLIP, f'{which} {done}{other} by '
                   f'{100 * abs(slips.size[worst]):.0f} cm relative to the gyro, from t = '
                   f'{slips.begin[worst]:.1f} s for '
                   f'{max(slips.end[worst] - slips.begin[worst], SLIP_GRID):.1f} s'
                   + (f'; {n} such places, {np.abs(slips.size).sum():.2f} m in total'
                      if n > 1 else '')),)
