# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead reckoning in the plane for many parameter sets at once (CN104359492A, steps 2 to 4).

A parameter set is left scale, right scale (m per unit) and heading (rad, counter-clockwise), a
rotation of the whole track. Its criteria are the distances between track and fixes, whose maximum
and mean the patent uses, and the directions of the track relative to the course over ground. The
refinement minimises the mean square of the distances. Positions are linear in the two scales, so
the tracks of the wheels are summed once, at one metre per unit, and a set costs two products of
matrices. Horizontal components in n are used, without a map projection.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.calib.drive import separated_fixes
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.nav.dead_reckoning import axes_from_forward, forward_b, Track
from odocal_ros.nav.rotations import arctan2, wrap

CHUNK = 500_000          # judgement: distances in memory at once: 4 MB, which stays in the cache
# statistical: sigmas beyond which the influence of a fix is constant: one in seven white fixes
HUBER = 2.0
MIN_SIGMA = 1e-4       # m, judgement: lower limit of a stated sigma


@dataclass(frozen=True, eq=False)
class PlanarLeg:
    """
    A leg of two wheels as input of the search; positions are east and north in n.

    left_n, right_n : track from the start to each fix by the travel of this wheel alone, for a
    scale factor of 1 m per unit and the configured heading.
    """

    t: Floats           # (k,) s, times of the fixes
    left_n: Floats      # (k, 2) m per m/unit
    right_n: Floats     # (k, 2) m per m/unit
    fixes_n: Floats     # (k, 2) m
    start_n: Floats     # (2,) m, antenna at the start, where every track begins
    sigma: Floats       # (k,) m, of each axis of a fix
    scale_left: float   # start value, m per unit
    scale_right: float  # start value, m per unit
    # (k, 2) m, change of the lever arm since the start by turns
    lever_n: Floats = field(default_factory=lambda: np.zeros((1, 2)))
    # (c, 2) first and last fix of the pieces of the drive that have a course over ground
    pieces: Ints = field(default_factory=lambda: np.empty((0, 2), np.int64))

    @property
    def start(self) -> Floats:
        """Return the start values as a parameter set: (3,)."""
        return np.array([self.scale_left, self.scale_right, 0.0])

    @cached_property
    def basis(self) -> tuple[Floats, Floats]:
        """
        Return the rows whose sum, weighted by a set's coefficients, is its rotated residuals.

        residual = (L K_L + R K_R) / 2 + lever - (fix - start) rotated by -heading: (5, k) east,
        (5, k) north for the coefficients K_L / 2, K_R / 2, 1, -cos heading, -sin heading.
        """
        east, north = (self.fixes_n - self.start_n).T
        lever = np.broadcast_to(self.lever_n, self.fixes_n.shape)
        rows = np.stack([self.left_n, self.right_n, lever])
        return (np.vstack([rows[..., 0], [east, north]]),
                np.vstack([rows[..., 1], [north, -east]]))


def planar_leg(track_left: Track, track_right: Track, t_fix: Floats, fixes_n: Floats,
               covariance_n: Floats, start: tuple[float, Floats], scales: tuple[float, float],
               pitch: float = 0.0, lever_v: ArrayLike = (0.0, 0.0, 0.0)) -> PlanarLeg:
    """
    Project a leg of two wheels on the plane.

    track_left, track_right : dead reckoned with the travel of each wheel alone, same attitude.
    t_fix, fixes_n, covariance_n : (k,), (k, 2 or 3), (k, 3, 3) fixes, s, m, m^2; those outside
    the tracks are left out.   start : (t, position_n) time, s, and antenna position, m, at the
    start of the tracks.   scales : (left, right) start values, m per unit.   pitch : pitch
    mounting angle, rad: the axes are those of yaw 0.   lever_v : (3,) antenna from the
    odometer's point, m.
    """
    t_start, start_n = start
    tracks = track_left, track_right
    reach = (max(t_start, *(track.t[0] for track in tracks)), min(track.t[-1] for track in tracks))
    use = (t_fix >= reach[0]) & (t_fix <= reach[1])
    t, fixes = t_fix[use], np.ascontiguousarray(fixes_n[use, :2])
    forward, origin = forward_b(0.0, pitch), np.array(float(t_start))
    left, right = (((track.P_at(t) - track.P_at(origin)) @ forward)[:, :2] for track in tracks)
    turn = track_left.C_nb_at(t) - track_left.C_nb_at(origin)
    sigma = np.sqrt((covariance_n[use, 0, 0] + covariance_n[use, 1, 1]) / 2)
    return PlanarLeg(t, left, right, fixes, np.array(start_n[:2], dtype=float), sigma,
                     float(scales[0]), float(scales[1]),
                     lever_n=(turn @ axes_from_forward(forward) @ np.asarray(lever_v))[:, :2],
                     pieces=course_pieces(fixes, sigma))


def course_pieces(fixes_n: Floats, sigma: Floats) -> Ints:
    """Return (c, 2) rows of fixes, end to end, each pair far enough apart for a course."""
    if not len(fixes_n):
        return np.empty((0, 2), np.int64)
    min_m = 10.0        # between two fixes for a course
    min_sigmas = 20.0   # of a fix: the sigma of a course is then 4 deg
    ends = separated_fixes(fixes_n, max(min_m, min_sigmas * float(np.median(sigma))))
    return np.stack([ends[:-1], ends[1:]], -1).astype(np.int64)


def coefficients(sets: Floats) -> Floats:
    """Return the coefficients of ``PlanarLeg.basis`` for parameter sets (m, 3): (m, 5)."""
    left, right, heading = np.asarray(sets, dtype=float).T
    return np.stack([left / 2, right / 2, np.ones_like(left), -np.cos(heading),
                     -np.sin(heading)], -1)


def squared_distances(leg: PlanarLeg, sets: Floats) -> Iterator[tuple[slice, Floats]]:
    """Yield (rows, squared distances of track and fix, m^2: (len(rows), k)) by bounded chunks."""
    east, north = leg.basis
    weight = coefficients(sets)
    step = max(1, CHUNK // max(1, len(leg.t)))
    for first in range(0, len(weight), step):
        rows = slice(first, first + step)
        d2, north2 = weight[rows] @ east, weight[rows] @ north
        d2 *= d2
        north2 *= north2
        d2 += north2
        yield rows, d2


@dataclass(frozen=True, eq=False)
class Scores:
    """Criteria of m parameter sets, (m,) each."""

    max: Floats          # m, distance of track and fix
    mean: Floats         # m
    rms: Floats          # m
    loss: Floats         # the mean square, m^2, or without unit if fixes are weighted
    course_mean: Floats  # rad, direction minus course over ground; NaN: no course
    course_rms: Floats   # rad

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
    columns = {f.name: np.full(m, np.nan) for f in fields(Scores)}
    for rows, d2 in squared_distances(leg, sets):
        columns['loss'][rows] = loss(d2, leg.sigma, robust)
        columns['rms'][rows] = np.sqrt(d2.mean(axis=1))
        np.sqrt(d2, out=d2)
        columns['max'][rows], columns['mean'][rows] = d2.max(axis=1), d2.mean(axis=1)
    if course and len(leg.pieces):
        difference = course_differences(leg, sets)
        columns['course_mean'] = np.angle(np.exp(1j * difference).mean(axis=1))
        columns['course_rms'] = np.sqrt((difference**2).mean(axis=1))
    return Scores(**columns)


def loss(d2: Floats, sigma: Floats, robust: bool) -> Floats:
    """
    Return the objective from (m, k) squared distances, m^2: (m,).

    The mean square; robust: the mean of Huber's function of the distance in sigmas, quadratic up
    to HUBER and linear beyond.
    """
    if not robust:
        return np.asarray(d2.mean(axis=1))
    z2 = d2 / np.maximum(sigma, MIN_SIGMA)**2
    tail = z2 > HUBER**2
    huber = np.where(tail, 2 * HUBER * np.sqrt(np.where(tail, z2, 0.0)) - HUBER**2, z2)
    return np.asarray(huber.mean(axis=1))


def weights(d2: Floats, sigma: Floats, robust: bool) -> Floats:
    """Return the least-squares weight of each fix, by (k,) squared distances, m^2: (k,)."""
    if not robust:
        return np.ones(len(d2))
    sigma = np.maximum(sigma, MIN_SIGMA)
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.sqrt(d2), 1e-12)) / sigma**2


def course_differences(leg: PlanarLeg, sets: Floats) -> Floats:
    """Return the direction of dead-reckoned pieces minus that by the fixes, rad: (m, c)."""
    first, last = leg.pieces.T
    weight = coefficients(sets)[:, :3]
    east, north = (rows[:3, last] - rows[:3, first] for rows in leg.basis)
    chord = leg.fixes_n[last] - leg.fixes_n[first]
    course = arctan2(chord[:, 1], chord[:, 0])
    reckoned = arctan2(weight @ north, weight @ east)
    return wrap(reckoned + np.asarray(sets, dtype=float)[:, 2:] - course)


def inflation(rows: Floats) -> float:
    """
    Return the variance inflation by correlation: 1 for white residuals, large for a drift.

    One plus twice the sum of their autocorrelations before the first negative one: the number of
    residuals per independent one.   rows : (2, k).
    """
    k = rows.shape[1]
    spectrum = np.abs(np.fft.rfft(rows, 2 * k, axis=1))**2
    power = np.fft.irfft(spectrum.sum(axis=0), 2 * k)[:k]
    if not power[0] > 0:
        return 1.0
    correlation = power / power[0]
    end = np.argmax(correlation < 0) if (correlation < 0).any() else k
    return float(1 + 2 * correlation[1:end].sum())
