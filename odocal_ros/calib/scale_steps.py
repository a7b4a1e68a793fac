# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of scale changes between legs beyond a random walk: new tyres, a load."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.calib.linked_legs import LinkedLegs
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import REMARK_SIGMAS

# 1 sigma of a permanent change of ln K, by any tyre, gear or counter: physical
FREE_STEP = 1.0


@dataclass(frozen=True)
class ScaleStep:
    """A change of ln K from border ``leg`` - 1 to border ``leg``, and its size in sigmas."""

    leg: int
    change: float
    sigmas: float


def scale_steps(borders: Sequence[Border], steps: Sequence[float] | Floats, drifting: str,
                angles: Sequence[str] = ()) -> list[ScaleStep]:
    """
    Compare the scale of each leg with its prediction by the earlier legs.

    borders : by time.   steps : (J - 1,) sigma of the change of ``drifting`` from leg to leg.
    drifting, angles : as for ``joint``.

    Returns
    -------
    Changes beyond REMARK_SIGMAS, in order. After a change, only later legs predict the scale.

    """
    steps, found = np.array(steps, float), []
    for j in range(1, len(borders)):
        legs = LinkedLegs(borders[:j + 1], drifting, steps[:j], angles)
        sigmas = float(legs.deviations()[j, legs.drifting])
        if abs(sigmas) <= REMARK_SIGMAS:
            continue
        steps[j - 1] = FREE_STEP
        legs = LinkedLegs(borders[:j + 1], drifting, steps[:j], angles)
        x, _ = legs.solve()
        before, now = (x[legs.place(k)[legs.drifting]] for k in (j - 1, j))
        found.append(ScaleStep(j, float(now - before), sigmas))
    return found
