# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Preintegrated sums over intervals, and up to times within them: docs/method.md (S4)."""

from dataclasses import dataclass, fields

from odocal_ros.data.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Intervals:
    """Sums over K intervals of length T, s; (K, ...) in the body frame at each begin."""

    T: Floats        # (K,)
    R: Floats        # (K, 3, 3) attitude at the end
    dv: Floats       # (K, 3) m/s
    dp: Floats       # (K, 3) m
    A: Floats        # (K, 3, 3) integral of R (1 - M_a), s: d dv = -A d ba
    AA: Floats       # (K, 3, 3) its integral: d dp = -AA d ba
    F: Floats        # (K, 3, a) integral of R's columns ACCEL_AXIS times the forces ACCEL_SIGNAL
    #                  less their biases: d dv = -F d constants; A times the mean force may be
    #                  millimetres off, which would determine a scale that is not observable
    FF: Floats       # (K, 3, a) its integral: d dp = -FF d constants
    # by the gyro bias (3) and by the constants of GYRO (g)
    turned: Floats   # (K, 3, 3 + g) rotation of the end: -turned d
    dv_by: Floats    # (K, 3, 3 + g) derivative of dv
    dp_by: Floats    # (K, 3, 3 + g)
    S: Floats        # (K, 3, 3) sum of R over travel, scale units
    S_by: Floats     # (K, 3, 3 + g) derivative of S @ forward
    mean_rate: Floats   # (K, 3) mean measured turn rate less its bias, rad/s
    mean_force: Floats  # (K, 3) mean measured specific force less its bias, m/s^2
    longest_step: Floats   # (K,) longest gap between IMU rows, s

    def take(self, rows: slice) -> 'Intervals':
        """Return the intervals of a slice."""
        return Intervals(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Points:
    """Sums from the begin of an interval to m times within it."""

    interval: Ints   # (m,)
    tau: Floats      # (m,) s since the begin
    dv: Floats       # (m, 3)
    dp: Floats       # (m, 3)
    R: Floats        # (m, 3, 3)
    A: Floats        # (m, 3, 3)
    AA: Floats       # (m, 3, 3)
    F: Floats        # (m, 3, a)
    FF: Floats       # (m, 3, a)
    turned: Floats   # (m, 3, 3 + g)
    dv_by: Floats    # (m, 3, 3 + g)
    dp_by: Floats    # (m, 3, 3 + g)
    force: Floats    # (m, 3) m/s^2, specific force, in the body frame at the begin
    rate: Floats     # (m, 3) rad/s, turn rate, in the body frame at the time
    spin: Floats     # (m, 3) rad/s^2, its rate of change
    measured: Floats    # (m, 6) turn rate and specific force less their biases, means of the step

    def take(self, index: Ints) -> 'Points':
        """Return the points selected by an index."""
        return Points(**{f.name: getattr(self, f.name)[index] for f in fields(self)})
