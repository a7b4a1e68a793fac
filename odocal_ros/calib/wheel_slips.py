# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Slips of single wheels, which wheel_faults.py detects with the gyro."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.reasons import Code, Reason

# s, judgement: between rows in the search for slips, which last a second or more
SLIP_GRID = 0.1


@dataclass(frozen=True, eq=False)
class WheelSlips:
    """Slips of single wheels, in order of time: (k,)."""

    begin: Floats    # s
    end: Floats      # s
    size: Floats     # m, > 0: the wheel turned too far; unknown wheel: right minus left
    wheel: Ints      # -1 left, +1 right, 0 unknown
    change: float = 0.0    # of the ratio right / left in the drive, as one step at half the path
    count: int = 2                   # number of wheels in the mean

    @property
    def t(self) -> Floats:
        """Return the middle of each slip, s."""
        return (self.begin + self.end) / 2

    def uncertain_travel(self) -> tuple[Floats, Floats]:
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


NO_SLIPS = WheelSlips(np.empty(0), np.empty(0), np.empty(0), np.empty(0, int))    # definition


def join_axles(axles: Sequence[WheelSlips], count: int) -> WheelSlips:
    """Return the slips of the wheels of several axles; count: number of wheels in the mean."""
    columns = {name: np.concatenate([getattr(slips, name) for slips in axles])
               for name in ('begin', 'end', 'size', 'wheel')}
    order = np.argsort(columns['begin'], kind='stable')
    return WheelSlips(**{name: column[order] for name, column in columns.items()},
                      change=math.hypot(*(slips.change for slips in axles)), count=count)


def wheel_slip_reason(slips: WheelSlips, names: tuple[str, ...]) -> tuple[Reason]:
    """Return the reason that names the wheel with the largest slip, its size and time."""
    n, worst = len(slips.size), int(np.argmax(np.abs(slips.size)))
    size, begin = slips.size[worst], slips.begin[worst]
    duration = max(slips.end[worst] - begin, SLIP_GRID)
    if slips.wheel[worst] == 0:
        event = 'one of the wheels deviates from the other'
    else:
        event = (f'the {names[int(slips.wheel[worst] > 0)]} wheel '
                 f'{"spins" if size > 0 else "slides"}')
    others = f'; {n} such places, {np.abs(slips.size).sum():.2f} m in total' if n > 1 else ''
    return (Reason(Code.WHEEL_SLIP, f'{event} by {100 * abs(size):.0f} cm relative to the gyro, '
                   f'from t = {begin:.1f} s for {duration:.1f} s{others}'),)
