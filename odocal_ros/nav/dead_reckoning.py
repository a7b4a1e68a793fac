# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead reckoning: track in n from attitude and odometer travel, linear in scale and forward axis.

n is Cartesian and fixed to the Earth, so that the track is exact on the ellipsoid; b: the IMU.

``P`` is the sum of attitude over travel: the track of a vehicle whose forward axis in b is d and
whose scale is K is P @ (K d). P does not depend on scale, yaw and pitch, so they can be solved
for, or varied, without another pass.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import chunks, Floats, map_rows, running_sum, work_array
from odocal_ros.nav import geodesy
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_quat
from odocal_ros.nav.time_series import robust_sigma

SHORT_SECTION = 2.0     # m, judgement: correlated fix errors change by less in that path
# judgement: ratio of scales from short and long sections above which the path folds back; noise of
# an eighth of a chord makes the short one 1 % longer
MIN_FOLD_RATIO = 1.3


@dataclass(frozen=True, eq=False)
class Origin:
    """
    Origin of n, a geodetic position.

    local_earth_rate : of a local frame, whose y axis does not point to north; None: it does.
    """

    latitude: float     # rad
    longitude: float    # rad
    height: float       # m, ellipsoidal
    local_earth_rate: geodesy.PartlyKnownRate | None = None

    @property
    def is_local(self) -> bool:
        """Return True if north is unknown: y of n is that of a local frame."""
        return self.local_earth_rate is not None

    @property
    def earth_rate_n(self) -> Floats:
        """Return the known part of the Earth's turn rate in n, rad/s: (3,)."""
        return geodesy.earth_rate_n(self.latitude) if self.local_earth_rate is None else (
            np.array(self.local_earth_rate.rate_n))

    def to_n(self, geodetic: Floats) -> Floats:
        """Return positions in n, m, from (..., 3) latitude, longitude (rad), height (m)."""
        r_e = geodesy.ecef_from_geodetic(geodetic[..., 0], geodetic[..., 1], geodetic[..., 2])
        origin_e = geodesy.ecef_from_geodetic(self.latitude, self.longitude, self.height)
        return (r_e - origin_e) @ geodesy.C_en(self.latitude, self.longitude)

    def to_geodetic(self, position_n: Floats) -> Floats:
        """Return (..., 3) latitude, longitude (rad), height (m) from positions in n, m."""
        origin_e = geodesy.ecef_from_geodetic(self.latitude, self.longitude, self.height)
        r_e = origin_e + position_n @ geodesy.C_en(self.latitude, self.longitude).T
        return np.stack(geodesy.geodetic_from_ecef(r_e), -1)


@dataclass(frozen=True, eq=False)
class Track:
    """A dead-reckoned leg, before scale and forward axis are chosen."""

    t: Floats       # (m,) s, epochs
    q_nb: Floats    # (m, 4) x y z w, attitude there
    s: Floats       # (m,) travel, scale units
    P: Floats       # (m, 3, 3) scale units, sum of C_nb over travel from the first epoch

    def P_at(self, t: float | Floats) -> Floats:
        """Return P at times t, linear between epochs, constant outside: (...) to (..., 3, 3)."""
        last = len(self.t) - 1
        k = np.clip(np.searchsorted(self.t, t, side='right') - 1, 0, max(last - 1, 0))
        after = np.minimum(k + 1, last)         # a track may have a single epoch
        min_interval = 1e-9    # s, shorter than any interval of epochs
        interval = np.maximum(self.t[after] - self.t[k], min_interval)
        share = np.clip((t - self.t[k]) / interval, 0.0, 1.0)[..., None, None]
        P, P_after = self.P.take(k, axis=0), self.P.take(after, axis=0)
        P *= 1 - share
        P_after *= share
        P += P_after
        return P

    def C_nb_at(self, t: float | Floats) -> Floats:
        """Return attitude at the epoch nearest to t: (...) to (..., 3, 3)."""
        k = np.clip(np.searchsorted(self.t, t), 1, len(self.t) - 1)
        k = np.where(np.abs(self.t[k - 1] - t) < np.abs(self.t[k] - t), k - 1, k)
        return matrix_from_quat(self.q_nb[k])

    def rows_between(self, begin: float, end: float) -> slice:
        """Return the epochs between two times, s, both included."""
        return slice(np.searchsorted(self.t, begin), np.searchsorted(self.t, end, side='right'))

    def displacement(self, rows: slice, t_start: float, f: Floats) -> Floats:
        """
        Return the displacement from t_start, s, to the epochs ``rows``: (m, 3) m.

        f : (3,) m per unit of travel, in b.
        """
        start = self.P_at(t_start)
        return map_rows(lambda P: (P - start) @ f, self.P[rows])


def dead_reckon(t: Floats, q_nb: Floats, travel: Travel) -> Track:
    """Return the track: sums of attitude times travel, trapezoid rule, docs/method.md (T1)."""
    s = travel.at(t)
    half, P = (np.diff(s) / 2)[:, None, None], work_array(len(t), 3, 3)
    for rows in chunks(len(t) - 1):
        C_nb = matrix_from_quat(q_nb[rows.start:rows.stop + 1])
        sums = C_nb[:-1] + C_nb[1:]
        sums *= half[rows]
        sums[0] += P[rows.start]
        np.cumsum(sums, axis=0, out=P[rows.start + 1:rows.stop + 1])
    return Track(t, q_nb, s, P)


def forward_b(yaw: float | Floats, pitch: float | Floats) -> Floats:
    """Return the forward axis in b for mounting angles, rad, docs/method.md (T2): (..., 3)."""
    return np.stack([np.cos(pitch) * np.cos(yaw), -np.sin(yaw) * np.ones_like(pitch),
                     np.sin(pitch) * np.cos(yaw)], -1)


def mounting_from_forward(d_b: ArrayLike) -> tuple[Floats, Floats]:
    """Return yaw and pitch mounting, rad, of an axis in b; backwards: yaw of pi (T5)."""
    d_b = np.asarray(d_b, dtype=float)
    x, y, z = d_b[..., 0], d_b[..., 1], d_b[..., 2]
    sign = np.where(x < 0, -1.0, 1.0)
    return np.arctan2(-y, sign * np.hypot(x, z)), np.arctan2(sign * z, sign * x)


def axes_from_forward(f: ArrayLike) -> Floats:
    """Return C_bv, (3, 3), for a forward axis in b of any length, (3,), and a roll of 0."""
    yaw, pitch = mounting_from_forward(np.asarray(f) / np.linalg.norm(f))
    forward = forward_b(yaw, pitch)
    left = np.array([np.cos(pitch) * np.sin(yaw), np.cos(yaw), np.sin(pitch) * np.sin(yaw)])
    return np.stack([forward, left, np.cross(forward, left)], -1)


def rough_scale(travel: Travel, t_fix: Floats, fixes_n: Floats, sigma: float,
                min_chord: float = geodesy.MIN_GNSS_MOTION) -> float | None:
    """
    Return metres per unit of travel from distances between fixes, None without motion.

    It is the median over sections of equal path length, as short as possible with chords of at
    least ``min_chord``, m, and of eight sigmas. Despite outliers its error is a few per cent:
    enough for thresholds and for scales without a nominal value. If the path folds back within
    ``min_chord`` (the lanes of a mower), the ratio of shorter sections is larger and is used.
    """
    inside = (t_fix >= travel.t[0]) & (t_fix <= travel.t[-1]) if len(travel.t) else []
    if not np.any(inside):
        return None
    s, p = travel.at(t_fix[inside]), fixes_n[inside, :2]
    scale = section_ratio(s, s[:, None], p, max(min_chord, 8 * sigma))
    if scale is None or len(s) < 5:
        return scale
    # third differences of white noise have 20 times its variance
    noise = robust_sigma(np.diff(p, 3, axis=0)) / np.sqrt(20)
    short = section_ratio(s, s[:, None], p, max(SHORT_SECTION, 8 * noise))
    return short if short is not None and short > MIN_FOLD_RATIO * scale else scale


def section_ratio(s: Floats, path: Floats, p: Floats, min_chord: float) -> float | None:
    """
    Return the median ratio of distances between fixes to those on a path, None without sections.

    s, path, p : (n,) travel, (n, k) path in units of travel, (n, 2) fixes, m, at the same times.
    Sections of equal travel, as short as possible with a median distance of ``min_chord``, m.
    """
    path_length = running_sum(np.abs(np.diff(s)))
    count = len(s) // 2      # of sections
    while count and path_length[-1] > 0:
        k = np.unique(np.searchsorted(path_length, np.linspace(0.0, path_length[-1], count + 1)))
        chord = np.hypot(*np.diff(p[k], axis=0).T)
        path_chord = np.sqrt((np.diff(path[k], axis=0)**2).sum(axis=1))
        moves = path_chord > 0
        if moves.any() and np.median(chord[moves]) >= min_chord:
            return float(np.median(chord[moves] / path_chord[moves]))
        count //= 2
    return None


def level_track(travel: Floats, turn: Floats) -> Floats:
    """Return the level path of travel, (n, 2) in its units; turn : (n,) rad about up."""
    middle = (turn[1:] + turn[:-1]) / 2
    step = np.diff(travel)[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1)
    return running_sum(step)


def gravity_n(position_n: Floats, origin: Origin) -> Floats:
    """Return gravity at positions in n, as a vector in n: (N, 3) m/s^2."""
    latitude, longitude, height = origin.to_geodetic(position_n).T
    up_e = geodesy.C_en(latitude, longitude)[..., 2]
    return np.asarray(-geodesy.gravity(latitude, height)[:, None] * (
        up_e @ geodesy.C_en(origin.latitude, origin.longitude)))
