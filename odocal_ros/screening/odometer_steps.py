# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An odometer's rows as steps of travel, as they come: rough, for what cannot wait."""

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, Values
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.screening.glitches import beyond

# counts, rad, m: less is not called motion
STILL_TRAVEL = {'m/pulse': 2.0, 'm/rad': 0.02, '1': 0.02}


class Steps:
    """Rows to steps, in odometer units; ``nav.odometer.travel`` does it with all rows at hand."""

    def __init__(self, form: OdometerForm) -> None:
        self.form = form
        self._last: tuple[Ints, Values] | None = None

    @property
    def still(self) -> float:
        """Return the travel up to which one that stands may seem to move."""
        return STILL_TRAVEL.get(self.form.scale_unit, 0.02)

    def of(self, block: OdometerSamples) -> tuple[Floats, Ints, Floats]:
        """
        Return the step of each row since the row before, its stamp, ns, and its duration, s.

        Rows without a possible value are passed over.
        """
        good = ~beyond('value', block.value)
        stamps, values = block.stamp_ns[good], block.value[good]
        if self._last is not None:
            stamps = np.r_[self._last[0], stamps]
            values = np.r_[self._last[1], values]
        self._last = (stamps[-1:], values[-1:])
        seconds = np.diff(stamps) * 1e-9
        if self.form.quantity == 'increment':
            steps = values[1:]
        elif self.form.quantity == 'rate':
            steps = values[1:] * seconds
        else:
            steps = np.diff(values)
            if 0 < self.form.modulus < 2**63:
                half = self.form.modulus // 2
                steps = (steps + half) % self.form.modulus - half
        return np.asarray(steps, dtype=np.float64), stamps[1:], seconds
