# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A result that was saved and came back with the parameters at start-up."""

from dataclasses import dataclass, replace

from odocal_ros.calib.result import Estimate
from odocal_ros.output.summary import values_in_words
from odocal_ros.outside.names import one_line


@dataclass(frozen=True, eq=False)
class Restored:
    """What the parameters ``result.*`` held at the start; the unit of a scale is not among it."""

    estimates: dict[str, Estimate]
    legs: int
    valid: bool
    stamp: str
    vehicle: str = ''

    def words(self, unit: str) -> str:
        """Return it as a sentence; ``unit`` is that of scales of the odometer, or empty."""
        estimates = {name: replace(e, unit=unit) if unit and name.startswith('scale_factor') else e
                     for name, e in self.estimates.items()}
        use = '' if self.valid else ', which was rejected'
        whose = f' of vehicle {one_line(self.vehicle)}' if self.vehicle else ''
        return (f'restored result of {self.stamp}{whose}{use}: {values_in_words(estimates)}; from '
                f'{self.legs} leg{"s" * (self.legs != 1)}')
