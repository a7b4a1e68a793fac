# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""External observations besides fixes, such as GNSS velocity: rows in n, and functions of them."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.angles import arctan2
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.earth import C_en
from odocal_ros.nav.rotations import transpose
from odocal_ros.screening.inputs import Inputs

# Hz: physical, errors of velocity and heading last longer than a fifth of a second
OUTSIDE_RATE = 5.0


@dataclass(frozen=True, eq=False)
class Outside:
    """Rows of a sensor in frame n: arrays of one length, times first."""

    t: Floats       # (m,) s

    def between(self, first: float, last: float) -> Self:
        """Return the rows between two times."""
        pick = (self.t >= first) & (self.t <= last)
        columns = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(self, **{name: column[pick] for name, column in columns.items()
                                if isinstance(column, np.ndarray)})


def thinned(t: Floats) -> slice:
    """Return an index that thins sorted times to about OUTSIDE_RATE."""
    rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
    return slice(None, None, max(1, round(rate / OUTSIDE_RATE)))


def from_place(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return C_np of the places at times: east and north differ from those at the origin."""
    latitude, longitude = (np.interp(t, inputs.t_fix, inputs.geodetic[:, i]) for i in (0, 1))
    return transpose(C_en(origin.latitude, origin.longitude)) @ C_en(latitude, longitude)


def convergence(inputs: Inputs, t: Floats, origin: Origin) -> Floats:
    """Return the yaw in n of east at the places of the vehicle: (m,) rad."""
    C_np = from_place(inputs, t, origin)
    return arctan2(C_np[:, 1, 0], C_np[:, 0, 0])
