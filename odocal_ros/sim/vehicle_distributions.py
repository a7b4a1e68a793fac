# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Distributions from which a random vehicle and its errors are drawn, by IMU grade.

``sim/draw.py`` draws the vehicle, ``sim/draw_effects.py`` its errors; docs/zoo.md has the sources.
"""

from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats

DRAWN_GRADES = ('consumer', 'industrial', 'tactical')
# definition: units of data sheets in SI; G as rounded there, far within any distribution here
G, MG, DEG, DEG_H, KMH = 9.81, 9.81e-3, math.radians(1.0), math.radians(1.0) / 3600, 1 / 3.6

# the values of a quantity by grade, as in DRAWN_GRADES: sigma of a normal distribution, 1 sigma of
# a process, or size with a random sign
SIGMAS: dict[str, tuple[Any, ...]] = {
    'gyro scale': (0.01, 1.5e-3, 3e-4),                                # relative
    'accelerometer scale': (0.01, 2e-3, 3e-4),
    'misalignment': (0.4 * DEG, 0.05 * DEG, 3e-4),                     # rad, of axes
    'triad rotation': (0.5 * DEG, 0.1 * DEG, 1e-3),                    # rad, gyro to accelerometer
    'g sensitivity': (0.05 * DEG / G, 0.008 * DEG / G, DEG_H / G),     # rad/s per m/s^2
    'gyro bias': (DEG, 0.1 * DEG, 5 * DEG_H),                          # rad/s
    'accelerometer bias': (25 * MG, 3 * MG, MG),                       # m/s^2
    'gyro instability': (200 * DEG_H, 25 * DEG_H, 0.5 * DEG_H),        # rad/s, of a process
    'accelerometer instability': (MG, 0.2 * MG, 0.05 * MG),            # m/s^2, of a process
    'rectification': (0.3e-3 / G, 0.06e-3 / G, 0.01e-3 / G),    # m/s^2 per (m/s^2)^2, random sign
    'imu jitter': (3e-3, 1e-3, 1e-5),                                  # s
    'nominal scale': (0.015, 0.025, 0.005),                            # relative
    'lever arm error': (0.15, 0.03, 0.01),                             # m, each axis
    'mounting': ((3.0, 3.0, 3.0), (1.5, 1.5, 2.0), (0.5, 0.5, 0.5)),   # deg: roll, pitch, yaw
}
# shares of the vehicles, or probabilities
SHARES: dict[str, tuple[Any, ...]] = {
    'rtk': (0.1, 0.4, 0.9),
    'unmeasured lever arms': (0.3, 0.1, 0.0),
    # of fine counts, coarse counts and a speed
    'odometers': ((0.6, 0.3, 0.1), (0.1, 0.2, 0.7), (1.0, 0.0, 0.0)),
}
# median, and sigma of the logarithm
LOGNORMALS: dict[str, tuple[Any, ...]] = {
    'gyro slope': ((0.02 * DEG, 0.7), (0.002 * DEG, 0.5), (0.5 * DEG_H, 0.5)),     # rad/s per K
    'accelerometer slope': ((0.5 * MG, 0.5), (0.05 * MG, 0.5), (0.02 * MG, 0.5)),  # m/s^2 per K
    'stamp latency': ((0.010, 0.6), (0.005, 0.5), (0.002, 0.5)),                   # s
}
# least and largest value of a uniform distribution
RANGES: dict[str, tuple[Any, ...]] = {
    'temperature rise': ((5.0, 25.0), (3.0, 10.0), (3.0, 5.0)),                    # K
    'imu filter delay': ((0.002, 0.019), (0.002, 0.010), (0.001, 0.016)),          # s
}
BY_GRADE = SIGMAS | SHARES | LOGNORMALS | RANGES


@dataclass(frozen=True)
class Effect:
    """An effect as the values that cause it; without any the effect is absent."""

    real: dict[str, Any] = field(default_factory=dict)       # fields of ``RealEffects``
    options: dict[str, Any] = field(default_factory=dict)    # fields of ``SimOptions``


@dataclass(frozen=True)
class Vehicle:
    """Properties of a vehicle that effects depend on."""

    grade: str       # consumer, industrial or tactical
    kind: str        # scenario of the drive
    rtk: bool        # GNSS with RTK
    city: bool       # multipath, outages, worse covariances
    robot: bool      # small, slow, without springs
    options: dict[str, Any]    # fields of SimOptions, before any effect
    effects_certain: bool    # the user names the effects: each is present, not by chance

    def grade_value(self, name: str) -> Any:
        """Return the entry of BY_GRADE for the vehicle's grade."""
        return BY_GRADE[name][DRAWN_GRADES.index(self.grade)]

    @property
    def speed_options(self) -> dict[str, Any]:
        """Return the options of an odometer that sends speeds with the same relative error."""
        return {'odometer': 'speed', 'nominal_scale': 1.0,
                'scale': self.options['scale'] / self.options['nominal_scale']}


def lognormal(rng: np.random.Generator, median: float, log_sigma: float) -> float:
    """Return a sample of a log-normal distribution; log_sigma: sigma of the logarithm."""
    return float(median * np.exp(log_sigma * rng.standard_normal()))


def flat(values: Floats) -> tuple[float, ...]:
    """Return the numbers of an array of any shape, row by row, as one tuple."""
    return tuple(float(x) for x in np.ravel(values))
