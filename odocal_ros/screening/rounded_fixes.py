# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Uncertainty of fixes with rounded coordinates: float32, or NMEA with few decimals."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.geodesy import radii
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FIX_NOISE_LIMIT

FINEST_ANGLE = 1e-10    # rad, physical: 0.6 mm: finer steps have no effect
# statistical: least number of differences; those of unrounded values are all multiples of one
# step once in 10^9
MIN_DIFFERENCES = 10
OFF_GRID = 0.02         # judgement: limit of the deviation from a multiple of a step, in steps


def rounding_variance(geodetic: Floats, covariance_n: Floats) -> tuple[Floats, tuple[Reason, ...]]:
    """
    Return the variances by rounding, (n, 3) m^2, and FIXES_NOISIER_THAN_SAID if they are large.

    A coordinate that is equal in m consecutive fixes has one error, uniform in its step, which
    their mean does not reduce: each has m times its variance.

    geodetic : (n, 3) latitude and longitude, rad, height, in order of time.   covariance_n : (n,
    3, 3) stated, m^2.
    """
    n = len(geodetic)
    variance = np.zeros((n, 3))
    angles = geodetic[:, 1::-1]     # along east and north
    steps = np.array([common_step(angle) for angle in angles.T])
    if not steps.any():
        return variance, ()
    # a coordinate that hardly changes has too few differences
    steps[steps == 0] = steps.max()
    latitude = float(np.median(geodetic[:, 0]))
    meridian, normal = radii(latitude)
    sizes = steps * (normal * np.cos(latitude), meridian)
    for axis, coordinate in enumerate(np.rint((angles - angles[0]) / steps).T):     # in steps
        first_equal = np.flatnonzero(np.diff(coordinate, prepend=np.nan))
        count = np.diff(first_equal, append=n)      # of consecutive fixes with equal coordinates
        variance[:, axis] = np.repeat(count, count) * sizes[axis]**2 / 12
    stated = np.sqrt(np.median(covariance_n.diagonal(axis1=1, axis2=2), axis=0)[:2])
    factor = float(np.hypot(1.0, sizes / np.sqrt(12) / stated).max())
    if factor <= FIX_NOISE_LIMIT:
        return variance, ()
    east, north = sizes
    return variance, (Reason(
        Code.FIXES_NOISIER_THAN_SAID, f'positions are rounded to {east:.2g} m east and '
        f'{north:.2g} m north: fix errors are {factor:.1f} times as large as their covariance '
        f'states (limit {FIX_NOISE_LIMIT:g}); accounted for', 'Publish latitude and longitude '
        'as double, unrounded or with at least 8 decimals of a degree (NMEA: 6 of a minute).'),)


def common_step(angle: Floats) -> float:
    """Return the greatest common divisor of differences of angles, (n,) rad; 0: none (Euclid)."""
    differences = np.diff(np.unique(angle))
    differences = differences[differences > FINEST_ANGLE]
    if len(differences) < MIN_DIFFERENCES:
        return 0.0
    step = float(differences.min())
    while step > FINEST_ANGLE:
        remainder = abs(differences - step * np.rint(differences / step))
        remainder = remainder[remainder > OFF_GRID * step]
        if not len(remainder):
            return step
        step = float(remainder.min())
    return 0.0
