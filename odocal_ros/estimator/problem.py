# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The estimation problem of a leg: data that is the same in all iterations."""

from dataclasses import dataclass, field

import numpy as np

from odocal_ros.estimator.imu import ImuSteps
from odocal_ros.estimator.leg import ExternalSamples, SmootherLeg
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.state import Priors
from odocal_ros.settings.nominal import Grade


@dataclass(eq=False)
class Problem:
    """A leg with its rows, whitening and priors: docs/method.md (S1), (S2)."""

    leg: SmootherLeg
    imu: ImuSteps
    grade: Grade
    priors: Priors
    use: np.ndarray          # (k,) bool, fixes within the keyframes
    root: np.ndarray         # (m, 3, 3) inverse roots of the stated covariances
    still: np.ndarray        # (N,) bool
    external: dict[str, ExternalSamples]    # within the keyframes
    own: dict[str, slice]    # slices of their constants, by source, that no other leg shares
    turned: float            # rad, in turns
    fix_time: float          # s, as gnss.correlation_time: 0 white, NaN estimated
    rate_b: np.ndarray       # (N, 3) rad/s, measured at the keyframes
    swings: np.ndarray       # (K, 3, 3) rad^2, of the angles within the intervals
    drift_time: np.ndarray   # (K,) s, in which the correlated fix error changes
    fix_least: float         # m, minimum sigma of fix errors, white and correlated each
    first_levels: Levels = field(default_factory=lambda: Levels({}))
    least: dict[str, float] = field(default_factory=dict)     # levels
    vibrating: dict[str, float] = field(default_factory=dict)    # initial levels of the IMU
    # velocity, heading, steps of speed: errors that are one
    rows_per_independent: dict[str, float] = field(default_factory=dict)

    @property
    def fix_sigma(self) -> float:
        """Return the median stated sigma of a horizontal axis of the fixes, m."""
        out: float = np.sqrt(np.median(self.leg.covariance_n[self.use][:, 0, 0]))
        return out

    @property
    def height_sigma(self) -> float:
        """Return the median stated sigma of the heights of the fixes, m."""
        out: float = np.sqrt(np.median(self.leg.covariance_n[self.use][:, 2, 2]))
        return out
