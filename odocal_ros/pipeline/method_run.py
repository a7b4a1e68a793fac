# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a method gives on one leg, and the stage that it is at."""

from collections.abc import Callable
from dataclasses import dataclass
from math import nan
from typing import NamedTuple

from odocal_ros.calib.result import MethodResult
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Reason

Passed = Callable[[int, float], None]      # called with the passes made, and Stage.change
Path = Callable[[Floats], Floats]     # t (n,) s to (n, 3) m, or t () to (3,)
WHOLE_FROM = 10.0     # judgement: sigmas from which their decimals mean nothing


class Paths(NamedTuple):
    """
    The antenna's path as configured and as calibrated: t (n,) to (n, 3) m, but for a constant.

    Both have one attitude, and the fit's angles where it determines none: they differ in what
    the calibration changes and in nothing else.
    """

    before: Path
    after: Path


class MethodRun(NamedTuple):
    """
    A method's result and what it found beside it.

    paths : None where it refuses.   found : of the data, said of the leg.   delays : 'gnss' or
    'odometer' to s late and sigma; None from a method that sees none.   odometer : slip or
    lateness that its track shows beside the IMU, said of the leg unless a better method has
    looked; None: it does not look.
    """

    result: MethodResult
    paths: Paths | None = None
    found: tuple[Reason, ...] = ()
    delays: dict[str, tuple[float, float]] | None = None
    odometer: tuple[Reason, ...] | None = None


@dataclass(frozen=True)
class Stage:
    """
    A stage of the work on a leg.

    name : the method at work, or ``tracks``; empty before the first.   done : share of the work
    in the stages before it, 0 to 1; when a fit ends cannot be foreseen.   passes : that its fit
    has made.   change : the largest change of a constant in the last of them, in sigmas; NaN
    before the first.
    """

    name: str = ''
    done: float = 0.0
    passes: int = 0
    change: float = nan

    def words(self) -> str:
        """Return it for people."""
        if not self.passes:
            return self.name
        change = f'{self.change:.0f}' if self.change >= WHOLE_FROM else f'{self.change:.2f}'
        return (f'{self.name}, {self.passes} pass{"es" * (self.passes > 1)} done, remaining '
                f'change {change} sigma')
