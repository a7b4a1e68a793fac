# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Lower limits of variance components: estimates can be smaller, settings can be 0."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LeastNoise:
    """
    Minimum sigma of each variance component.

    Physical: the best receivers of today; for an IMU a tenth of navigation grade, since one with a
    dead band has no noise at rest.
    """

    fix: float = 0.005          # m, east or north or up, of white and of slow errors each
    pose: float = 2e-4          # m, of positions in a local frame: motion capture
    velocity: float = 0.005     # m/s, of an external velocity
    heading: float = 5e-4       # rad, of an external heading
    height: float = 0.02        # m, by air pressure
    travel: float = 1e-3        # m, of a reading of the odometer
    road: float = 2e-4          # m/sqrt(s) along the path: texture of the road under a tyre
    # gyro rad/s/sqrt(Hz), accelerometer m/s^2/sqrt(Hz), their walks rad/s/sqrt(s), m/s^2/sqrt(s)
    imu: dict[str, float] = field(default_factory=lambda: {
        'gyro': 3e-8, 'accel': 1e-5, 'gyro_walk': 2e-11, 'accel_walk': 1e-7})


LEAST = LeastNoise()
