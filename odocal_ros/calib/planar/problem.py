# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Input and result of a planar fit."""

from dataclasses import dataclass, field

import numpy as np

from odocal_ros.calib.planar.drive import Wheels
from odocal_ros.data.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Run:
    """
    A run on n + 1 nodes in time.

    t : (n + 1,) s.   wheels : increments between nodes.   node : (k,) nodes with a position.
    position : (k, 2) m.   sigma : (k,) m, stated white error.   gyro : (n,) rad, integral of the
    turn rate about the up axis; empty without a gyro.
    """

    t: Floats
    wheels: Wheels
    node: Ints
    position: Floats
    sigma: Floats
    gyro: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class Known:
    """
    Prior knowledge of a run; sigmas are 1 sigma, in SI units.

    width : track width, m, 0 unknown; of several minima the nearest is used.   offset : (2,) m of
    the tracked point ahead and left of the middle of the wheels.   drift_length
    : m of path, correlation length of position errors.   gyro_noise : rad/sqrt(s).
    """

    width: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    offset_sigma: float = 0.1
    delay_sigma: float = 0.05
    drift_length: float = 10.0
    gyro_noise: float = 1e-4
    gyro_scale_sigma: float = 0.02
    gyro_bias_sigma: float = 0.01


@dataclass(frozen=True, eq=False)
class Fit:
    """
    Estimated constants: names, values (m,), covariance (m, m).

    pose : (n + 1, 3) m, m, rad.   levels : sigma of each noise by name.   passes : their number.
    converged : False at the limit of passes.   swapped : left and right wheels are swapped.
    """

    names: tuple[str, ...]
    value: Floats
    covariance: Floats
    pose: Floats
    levels: dict[str, float]
    passes: int
    converged: bool
    swapped: bool
