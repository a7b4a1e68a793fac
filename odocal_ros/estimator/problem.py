# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The estimation problem of one leg: the data that stay the same in all iterations of its fit.

``prepare.make_problem`` makes it; the factors (``factors/``) take their measurements from it.
"""

from dataclasses import dataclass, field

import numpy as np

from odocal_ros.estimator.imu import ImuSteps
from odocal_ros.estimator.leg import ExternalSamples, SmootherLeg
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.state import Priors
from odocal_ros.settings.nominal import Grade


@dataclass(eq=False)
class Problem:
    """
    A leg with everything that is computed once before the first iteration of its fit.

    Keyframes t_k, k < N, are one second apart; K = N - 1 intervals lie between them.
    """

    leg: SmootherLeg
    imu: ImuSteps            # IMU samples as sums over steps of 0.1 s; the keyframes
    grade: Grade             # of the IMU, as configured or from its noise at rest
    priors: Priors           # docs/method.md (S21)
    used_fixes: np.ndarray   # (k,) bool, fixes of the leg between first and last keyframe
    fix_whitening: np.ndarray     # (m, 3, 3) inverse Cholesky factors of the stated covariances
    at_rest: np.ndarray      # (N,) bool, keyframes in a standstill
    external: dict[str, ExternalSamples]    # other sensors, between first and last keyframe
    # constants of other sensors that no other leg shares: their slices, by source in the budget
    unshared_constants: dict[str, slice]
    total_turn: float        # rad, sum of the angles of all turns
    correlation_time: float  # s, gnss.correlation_time: 0 white fix errors, NaN estimated
    rate_b: np.ndarray       # (N, 3) rad/s in b, measured turn rate at the keyframes
    brief_accelerations: np.ndarray  # (N, 3) m/s^2 in b, at keyframes, not in the speeds there
    angle_covariances: np.ndarray    # (K, 3, 3) rad^2, scatter of the attitude in an interval
    drift_time: np.ndarray   # (K,) s, time in which the correlated fix error changes
    min_fix_sigma: float     # m, of the white and of the correlated fix error each
    # by name: variances, or factors on stated variances (``PointRows``)
    initial_levels: Levels = field(default_factory=lambda: Levels({}))
    min_levels: dict[str, float] = field(default_factory=dict)
    vibrating_levels: dict[str, float] = field(default_factory=dict)  # initial, of a vibrating IMU
    # adjacent rows that share one error, by sensor: GNSS velocity, heading, speed steps
    rows_per_independent: dict[str, float] = field(default_factory=dict)

    @property
    def fix_sigma(self) -> float:
        """Return the median stated sigma of a horizontal axis of the fixes, m."""
        return float(np.sqrt(np.median(self.leg.covariance_n[self.used_fixes][:, 0, 0])))

    @property
    def height_sigma(self) -> float:
        """Return the median stated sigma of the heights of the fixes, m."""
        return float(np.sqrt(np.median(self.leg.covariance_n[self.used_fixes][:, 2, 2])))
