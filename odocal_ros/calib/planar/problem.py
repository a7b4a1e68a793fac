# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Input and result of a planar fit."""

from dataclasses import dataclass, field

import numpy as np

from odocal_ros.calib.planar.drive import Wheels
from odocal_ros.data.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Run:
    """A run on n + 1 nodes in time."""

    t: Floats         # (n + 1,) s
    wheels: Wheels    # increments between nodes
    node: Ints        # (k,) nodes with a position
    position: Floats  # (k, 2) m
    sigma: Floats     # (k,) m, stated white error
    gyro: Floats = field(default_factory=lambda: np.empty(0))  # (n,) rad; empty: no gyro


@dataclass(frozen=True, kw_only=True)
class Known:
    """Prior knowledge of a run; sigmas are 1 sigma, in SI units."""

    width: float = 0.0          # m, track width, 0 unknown; of several minima the nearest is used
    offset: tuple[float, float] = (0.0, 0.0)  # m, tracked point ahead and left of the wheels
    offset_sigma: float = 0.1
    delay_sigma: float = 0.05
    drift_length: float = 10.0  # m of path, correlation length of position errors
    gyro_noise: float = 1e-4    # rad/sqrt(s)
    gyro_scale_sigma: float = 0.02
    gyro_bias_sigma: float = 0.01


@dataclass(frozen=True, eq=False)
class Fit:
    """Estimated constants."""

    names: tuple[str, ...]
    value: Floats             # (m,)
    covariance: Floats        # (m, m)
    pose: Floats              # (n + 1, 3) m, m, rad
    levels: dict[str, float]  # sigma of each noise
    passes: int               # their number
    converged: bool           # False at the limit of passes
    swapped: bool             # left and right wheels are swapped
