# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where, between legs of a vehicle, the scale changed by more than a walk: new tyres, a load."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.calib.linked_legs import LinkedLegs
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import REMARK_SIGMAS

# 1 sigma of ln K where it changes for good, by any tyre, gear or counter: physical
FREE_STEP = 1.0


@dataclass(frozen=True)
class ScaleStep:
    """A change: from leg ``leg`` - 1 to ``leg`` of the borders, of ln K, and in sigmas."""

    leg: int
    change: float
    sigmas: float


def scale_steps(borders: Sequence[Border], steps: Sequence[float] | Floats, drifting: str,
                angles: Sequence[str] = ()) -> list[ScaleStep]:
    """
    Compare each leg's scale with its prediction by those before.

    borders : by time.   steps : (J - 1,) sigma by which ``drifting`` walks from leg to leg.
    drifting, angles : as for ``joint``.

    Returns
    -------
    Changes beyond REMARK_SIGMAS, in order. After one, a leg is held against those since.

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
