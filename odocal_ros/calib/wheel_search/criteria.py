# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Criteria of parameter sets: distances at the fixes, and heading relative to course over ground.

The patent uses the maximum and the mean of the distances, and names the receiver's course as an
additional criterion. The refinement minimises the mean square.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheel_search.planar import coefficients, PlanarLeg, squared_distances
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.angles import arctan2, wrap

# statistical: sigmas beyond which the influence of a fix is constant: one in seven white fixes
HUBER = 2.0
LEAST_SIGMA = 1e-4       # m, judgement: lower limit of a stated sigma


@dataclass(frozen=True, eq=False)
class Scores:
    """
    Criteria of m parameter sets, (m,) each.

    max, mean, rms : m, distance of track and fix.   loss : objective; the mean square, m^2, or
    without unit if fixes are weighted.   course_mean, course_rms : rad, dead-reckoned direction
    minus course over ground, counter-clockwise; NaN if the fixes give no course.
    """

    max: NDArray[np.float64]
    mean: NDArray[np.float64]
    rms: NDArray[np.float64]
    loss: NDArray[np.float64]
    course_mean: NDArray[np.float64]
    course_rms: NDArray[np.float64]

    def row(self, k: int) -> dict[str, float | None]:
        """Return the criteria of one set for text and JSON, m and deg; None: no course."""
        course = {f'course_{name}_deg': np.rad2deg(float(getattr(self, f'course_{name}')[k]))
                  for name in ('mean', 'rms')}
        return {'max': float(self.max[k]), 'mean': float(self.mean[k]),
                'rms': float(self.rms[k])} | {
            name: None if np.isnan(angle) else float(angle) for name, angle in course.items()}


def score(leg: PlanarLeg, sets: Floats, robust: bool = False, course: bool = True) -> Scores:
    """
    Return the criteria of parameter sets.

    leg : tracks and fixes.   sets : (m, 3) left and right scale, m per unit, and heading, rad.
    robust : weight fixes by their sigma and limit the influence of outliers in ``loss``.
    course : also compare with the course over ground.
    """
    sets = np.atleast_2d(np.asarray(sets, dtype=float))
    m = len(sets)
    found = {f.name: np.full(m, np.nan) for f in fields(Scores)}
    for rows, d2 in squared_distances(leg, sets):
        found['loss'][rows] = loss(d2, leg.sigma, robust)
        found['rms'][rows] = np.sqrt(d2.mean(axis=1))
        np.sqrt(d2, out=d2)
        found['max'][rows], found['mean'][rows] = d2.max(axis=1), d2.mean(axis=1)
    if course and len(leg.pieces):
        off = course_differences(leg, sets)
        found['course_mean'] = np.angle(np.exp(1j * off).mean(axis=1))
        found['course_rms'] = np.sqrt((off**2).mean(axis=1))
    return Scores(**found)


def loss(d2: Floats, sigma: Floats, robust: bool) -> Floats:
    """
    Return the objective from (m, k) squared distances, m^2: (m,).

    The mean square; robust: the mean of Huber's function of the distance in sigmas, quadratic up
    to HUBER and linear beyond.
    """
    if not robust:
        mean: Floats = d2.mean(axis=1)
        return mean
    z2 = d2 / np.maximum(sigma, LEAST_SIGMA)**2
    far = z2 > HUBER**2
    grown: Floats = np.where(far, 2 * HUBER * np.sqrt(np.where(far, z2, 0.0)) - HUBER**2, z2)
    mean = grown.mean(axis=1)
    return mean


def weights(d2: Floats, sigma: Floats, robust: bool) -> Floats:
    """Return the least-squares weight of each fix, by (k,) squared distances, m^2: (k,)."""
    if not robust:
        return np.ones(len(d2))
    sigma = np.maximum(sigma, LEAST_SIGMA)
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.sqrt(d2), 1e-12)) / sigma**2


def course_differences(leg: PlanarLeg, sets: Floats) -> Floats:
    """Return the direction of dead-reckoned pieces minus that by the fixes, rad: (m, c)."""
    a, b = leg.pieces.T
    mix = coefficients(sets)[:, :3]
    east, north = (rows[:3, b] - rows[:3, a] for rows in leg.basis)
    path_length = leg.fixes_n[b] - leg.fixes_n[a]
    course = arctan2(path_length[:, 1], path_length[:, 0])
    reckoned = arctan2(mix @ north, mix @ east)
    return wrap(reckoned + np.asarray(sets, dtype=float)[:, 2:] - course)
