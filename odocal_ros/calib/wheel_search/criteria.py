# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
How well parameter sets do: distances at the fixes, and heading against course over ground.

The patent has the maximum and the mean of the distances, and names the receiver's course as a
standard besides. The mean square is what the refinement lowers.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheel_search.planar import coefficients, PlanarLeg, squared_distances
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.angles import arctan2, wrap

# statistical: sigmas at which a fix's pull stops growing; one in seven white fixes is beyond
HUBER = 2.0
LEAST_SIGMA = 1e-4       # m, judgement: lower limit of a stated sigma


@dataclass(frozen=True, eq=False)
class Scores:
    """
    Criteria of m parameter sets, (m,) each.

    max, mean, rms : m, distance of track and fix.   loss : what is lowered; m^2, the mean square,
    or without unit where fixes are weighted.   course_mean, course_rms : rad, dead-reckoned
    direction less course over ground, counter-clockwise; NaN where the fixes give no course.
    """

    max: NDArray[np.float64]
    mean: NDArray[np.float64]
    rms: NDArray[np.float64]
    loss: NDArray[np.float64]
    course_mean: NDArray[np.float64]
    course_rms: NDArray[np.float64]

    def row(self, k: int) -> dict[str, float | None]:
        """Return one set's criteria for people and JSON: m, deg; None: no course."""
        course = {f'course_{name}_deg': np.rad2deg(float(getattr(self, f'course_{name}')[k]))
                  for name in ('mean', 'rms')}
        return {'max': float(self.max[k]), 'mean': float(self.mean[k]),
                'rms': float(self.rms[k])} | {
            name: None if np.isnan(angle) else float(angle) for name, angle in course.items()}


def score(leg: PlanarLeg, sets: Floats, robust: bool = False, course: bool = True) -> Scores:
    """
    Return the criteria of parameter sets.

    leg : what was driven.   sets : (m, 3) left and right scale, m per unit, and heading, rad.
    robust : weight fixes by their sigma and bound the pull of outliers in ``loss``.   course :
    compare with the course over ground too.
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

    The mean square; robust: the mean of Huber's function of the distance in sigmas, which grows
    as the square up to HUBER and in proportion beyond.
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
    """Return by how much each fix pulls at the parameters, of (k,) squared distances: (k,)."""
    if not robust:
        return np.ones(len(d2))
    sigma = np.maximum(sigma, LEAST_SIGMA)
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.sqrt(d2), 1e-12)) / sigma**2


def course_differences(leg: PlanarLeg, sets: Floats) -> Floats:
    """Return direction of the dead-reckoned minus that of the fix path, rad: (m, c)."""
    a, b = leg.pieces.T
    mix = coefficients(sets)[:, :3]
    east, north = (rows[:3, b] - rows[:3, a] for rows in leg.basis)
    path_length = leg.fixes_n[b] - leg.fixes_n[a]
    course = arctan2(path_length[:, 1], path_length[:, 0])
    reckoned = arctan2(mix @ north, mix @ east)
    return wrap(reckoned + np.asarray(sets, dtype=float)[:, 2:] - course)
