# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Position references of a simulated drive: topic, message type and usual errors of each kind."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.sim.noise import stream

REMAINDER = 0.2     # judgement: share of the accumulated drift that a loop closure leaves


@dataclass(frozen=True)
class Reference:
    """A kind of reference."""

    topic: str
    encoder: str            # function of ``bagio.encode``
    planar: bool = False    # z is 0, as of 2D SLAM
    stated: bool = False    # with a covariance
    usual: dict[str, Any] = field(default_factory=dict)    # SimOptions of this kind


# Judgement, by data sheets and documentation: motion capture 0.1 to 1 mm at 50 to 200 Hz; total
# stations that track a prism 1 to 5 mm; laser scanners 1 to 3 cm of noise, and scan matching that
# drifts by 0.5 to 1 % of a path of some metres; AMCL with the grid of its map, 5 cm
REFERENCES = {
    'fix': Reference('/fix', 'fix', stated=True),
    'pose': Reference('/pose', 'pose'),
    'mocap': Reference('/mocap/pose', 'pose', usual={'fix_sigma': 0.001, 'fix_rate': 50.0}),
    'total_station': Reference('/prism', 'point', usual={'fix_sigma': 0.002, 'fix_rate': 10.0}),
    'slam': Reference('/slam/pose', 'pose_with_covariance', True, True, {
        'fix_sigma': 0.02, 'fix_rate': 10.0, 'reference_drift': 0.01, 'closure_time': 30.0}),
    'amcl': Reference('/amcl_pose', 'pose_with_covariance', True, True, {
        'fix_sigma': 0.01, 'fix_rate': 5.0, 'reference_drift': 0.05, 'drift_length': 2.0}),
}


def drift(t: Floats, travel: Floats, options: Any) -> Floats | float:
    """Return errors (n, 3) m, ENU, that change with travel (n,), m, and jump at loop closures."""
    if not options.reference_drift:
        return 0.0
    rng, length = stream(options.seed, 'reference drift'), options.drift_length
    path = np.abs(np.diff(travel, prepend=travel[:1]))
    left = np.exp(-path / length) if length else np.ones(len(t))
    closes = stream(options.seed, 'loop closures').uniform(size=len(t)) < np.diff(
        t, prepend=t[:1]) / (options.closure_time or np.inf)
    usual = stationary_sigma(options)
    size = usual * np.sqrt(1 - left**2) if length else options.reference_drift * np.sqrt(path)
    left = np.where(closes, REMAINDER, left)
    out, steps = np.zeros((len(t), 3)), size[:, None] * rng.standard_normal((len(t), 2))
    out[0, :2] = usual * rng.standard_normal(2)
    for k in range(1, len(t)):
        out[k, :2] = left[k] * out[k - 1, :2] + steps[k]
    return out


def stationary_sigma(options: Any) -> float:
    """Return the stationary sigma of a correlated drift, m; 0 for a random walk."""
    return float(options.reference_drift * np.sqrt(options.drift_length / 2))
