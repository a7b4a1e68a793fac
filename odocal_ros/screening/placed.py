# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where a leg's fixes lie, and how far a count reaches: by one rule, before any method."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from odocal_ros.nav.dead_reckoning import Origin, rough_scale
from odocal_ros.nav.earth import rate_without_north
from odocal_ros.screening.fix_screen import origin_amid
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import nominal_scale

if TYPE_CHECKING:
    from odocal_ros.screening.screen import Inputs


@dataclass(frozen=True, eq=False)
class Placed:
    """
    Fixes in metres, and the scale as far as it is known.

    origin : of n.   fixes_n : (k, 3) m, NaN up where a fix has no height.   fix_sigma : m, usual
    1 sigma of an axis in the plane, NaN without fixes.   nominal : K0, metres per unit of travel,
    0 unknown.   rough : by the fixes, K0 where they move too little.
    """

    origin: Origin
    fixes_n: NDArray[np.float64]
    fix_sigma: float
    nominal: float
    rough: float


def place(inputs: 'Inputs', config: Config) -> Placed:
    """
    Return the fix positions of screened inputs and the metres per count.

    inputs : Inputs.   config : Config, for the nominal scale and the latitude of a local frame.
    """
    nominal = nominal_scale(config, inputs.scale_unit)
    if not len(inputs.t_fix):
        return Placed(Origin(0.0, 0.0, 0.0), np.empty((0, 3)), np.nan, nominal, nominal)
    origin = origin_amid(inputs.t_fix, inputs.geodetic)
    if inputs.local:
        latitude = np.deg2rad(config.reference.latitude_deg)
        origin = replace(origin, local=rate_without_north(float(latitude)))
    geodetic = inputs.geodetic.copy()
    lost = np.isnan(geodetic[:, 2])
    geodetic[lost, 2] = origin.height
    fixes_n = origin.to_n(geodetic)
    fixes_n[lost, 2] = np.nan
    sigma = float(np.sqrt(np.median(inputs.covariance_n[:, 0, 0])))
    rough = rough_scale(inputs.travel, inputs.t_fix, fixes_n, sigma,
                        inputs.least_motion) or nominal
    return Placed(origin, fixes_n, sigma, nominal, rough)
