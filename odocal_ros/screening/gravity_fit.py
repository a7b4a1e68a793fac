# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of mirrored or swapped gyro axes by gravity: a coefficient for each axis of the gyro.

Hills, bumps and braking tilt a vehicle: gravity turns in the frame of the accelerometer, and the
gyro must measure this turn. With level axes e1, e2, yaw psi by the gyro, turn rates w1, w2, w3
about e1, e2 and up, speed v and gravity g, the specific force, as a complex number e1 + i e2, is

    F = F0 + i g int (w1 + i w2) exp(i psi) dt + d/dt (v exp(i psi)).

Each gyro axis has a coefficient of its own, so the second term is
``i g int (c1 w1 + c2 w2 + c3 w3) exp(i psi) dt`` with c = (1, i, 0) for a correct gyro. A mirrored
axis has the opposite coefficient, swapped axes have swapped coefficients. The drive is cut into
segments, each with its own constant F0 and gyro bias.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import bin_means, Bools, Complexes, Floats, running_sum
from odocal_ros.nav.odometer import Travel
from odocal_ros.settings.nominal import G

ROW_S, ROWS_A_SECOND = 0.25, 4       # s, judgement: the yaw between rows stays small
# number of segments, and limits of their length, s. Tuned by benchmarks/zoo.py, 90 drives of 150
# to 600 s: shorter or longer segments detect less
SEGMENTS, SHORTEST_S, LONGEST_S = 12, 10, 30
MOVING_SPEED = 0.5      # m/s, judgement: mean of a segment in which a vehicle drives
WEIGHTING_PASSES = 4    # judgement: the weights of segments have converged


@dataclass(frozen=True, eq=False)
class GravityFit:
    """Coefficients of the gyro axes w1, w2, w3: (3,) each."""

    coefficient: Complexes    # 1, i and 0 for a correct gyro
    sigma: Floats             # from the scatter of the segments
    segments: Floats          # effective number of segments that determine it

    def chance(self, k: int, correct: complex) -> float:
        """
        Return the probability that a gyro with a correct axis k has this coefficient by chance.

        correct : its coefficient; noise of the gyro attenuates it, and the nearest value from
        there to 0 is used. Student's t in the complex plane: the scatter of ``segments`` segments
        has one degree of freedom less.
        """
        c = self.coefficient[k]
        expected = np.clip((np.conj(correct) * c).real, 0.0, 1.0) * correct
        freedom = max(self.segments[k] - 1, 1e-9)
        ratio = abs(c - expected)**2 / (self.sigma[k]**2 * freedom)
        return float((1 + ratio)**-freedom)


def gravity_fit(t: Floats, w: Floats, f: Floats, axes: Floats, travel: Travel,
                metres_per_unit: float) -> GravityFit | None:
    """
    Return the coefficients of the gyro axes, None if the drive is too short.

    t, w, f : (n,), (n, 3), (n, 3) times, s, turn rate, rad/s, and specific force, m/s^2, in one
    frame fixed to the IMU.   axes : (3, 3) rows e1, e2, up in that frame: right-handed.   travel :
    odometer; positive is forward.   metres_per_unit : its approximate scale.
    """
    begin, end = max(t[0], travel.t[0]), min(t[-1], travel.t[-1])
    edges = begin + ROW_S * np.arange(max(int((end - begin) / ROW_S), 0) // ROWS_A_SECOND
                                      * ROWS_A_SECOND + 1)
    if len(edges) <= SHORTEST_S * ROWS_A_SECOND:
        return None
    count, (w, f) = bin_means(t, edges, w, f)
    has_rows = count > 0
    if not has_rows.any():
        return None
    w = np.where(has_rows[:, None], w - np.median(w[has_rows], axis=0), 0.0)
    f = np.where(has_rows[:, None], f, np.median(f[has_rows], axis=0))
    return _fit(*_segments(w @ axes.T, f @ axes.T, travel.at(edges) * metres_per_unit, has_rows))


def _segments(w: Floats, f: Floats, s: Floats, has_rows: Bools) -> tuple[Complexes, Complexes]:
    """
    Return regressors, (k, m, 9), and forces, (k, m), m/s^2, of k segments of m seconds.

    Regressors are the tilts by the three gyro axes, then accelerations. Constant and gyro bias of
    each segment are removed from both.

    w, f : (n, 3) rad/s, m/s^2, in rows of ROW_S, along e1, e2, up.   s : (n + 1,) m, travel at
    their edges.   has_rows : (n,) True if the IMU has samples there.
    """
    half = ROWS_A_SECOND // 2
    speed = np.zeros(len(s))
    speed[half:-half] = s[ROWS_A_SECOND:] - s[:-ROWS_A_SECOND]
    speed = speed[::ROWS_A_SECOND]
    driven_s = np.count_nonzero(np.abs(speed) > MOVING_SPEED)
    length = int(np.clip(driven_s // SEGMENTS, SHORTEST_S, LONGEST_S))

    def cut(x: NDArray[Any]) -> NDArray[Any]:      # into segments
        k = len(x) // length
        return x[:k * length].reshape(k, length, *x.shape[1:])
    psi = running_sum(w[:, 2]) * ROW_S
    rotation = np.exp(0.5j * (psi[1:] + psi[:-1]))
    tilts = [_means_of_seconds(_integral(1j * G * rate * rotation)) for rate in w.T]
    bias_tilt = _means_of_seconds(_integral(rotation))
    force = _means_of_seconds((f[:, 0] + 1j * f[:, 1]) * rotation)
    direction = np.exp(1j * psi[::ROWS_A_SECOND])
    forward = np.diff(speed) * (direction[1:] + direction[:-1]) / 2
    centripetal = np.diff(direction) * (speed[1:] + speed[:-1]) / 2
    turn_rate, heading = _means_of_seconds(w[:, 2]), _means_of_seconds(rotation)
    # the derivatives model delays, the last two a lever arm of the IMU
    accelerations = [forward, centripetal, np.gradient(forward), np.gradient(centripetal),
                     np.gradient(turn_rate) * heading, turn_rate**2 * heading]
    regressors = cut(np.stack([*tilts, *accelerations], -1))
    offsets = cut(np.stack([np.ones_like(bias_tilt), bias_tilt], -1))
    # orthonormal: constant, and tilt by the gyro bias minus its mean
    basis, _ = np.linalg.qr(offsets - [0.0, 1.0] * offsets.mean(1, keepdims=True))
    use = cut(_means_of_seconds(has_rows) == 1).all(axis=1) & (
        np.abs(cut((speed[1:] + speed[:-1]) / 2)).mean(axis=1) > MOVING_SPEED)

    def without_offsets(x: Complexes) -> Complexes:
        return np.asarray((x - basis @ (basis.conj().swapaxes(1, 2) @ x))[use])
    return without_offsets(regressors), without_offsets(cut(force)[..., None])[..., 0]


def _fit(X: Complexes, force: Complexes) -> GravityFit | None:
    """
    Return the least-squares coefficients of the gyro axes; None with too few segments.

    X, force : (k, m, p), (k, m) regressors, gyro axes first, and forces. A segment has the inverse
    of its residual variance as weight; sigmas are by the sandwich formula, robust to this.
    """
    n, _, p = X.shape
    if n <= p:
        return None
    adjoint = X.conj().swapaxes(1, 2)
    normal, right = adjoint @ X, (adjoint @ force[..., None])[..., 0]
    scale = np.sqrt(np.einsum('kii->i', normal).real)
    scale[scale == 0] = 1.0             # an acceleration that is always zero
    normal, right = normal / (scale[:, None] * scale), right / scale
    weight = np.ones(n)
    rounding = 1e-9 * np.eye(p)    # of the unit diagonal: the matrix stays invertible
    for _ in range(WEIGHTING_PASSES):
        used = weight / weight.mean()
        inverse = np.linalg.inv(np.einsum('k,kij->ij', used, normal) + rounding)
        solution = inverse @ (used @ right)
        residual = force - X @ (solution / scale)
        variance = (np.abs(residual)**2).mean(axis=1)
        weight = 1 / np.maximum(variance + np.median(variance), 1e-12)
    # sandwich: the scatter of the segments' scores, not their stated variance
    score = used[:, None] * (adjoint @ residual[..., None])[..., 0] / scale
    influence = np.abs(score @ inverse.T)[:, :3] / scale[:3]
    sigma = np.sqrt((influence**2).sum(axis=0) * n / (n - p))
    # effective number of segments (Kish), from the information of each
    share = np.einsum('ij,kjl,li->ki', inverse, used[:, None, None] * normal, inverse).real[:, :3]
    segments = share.sum(axis=0)**2 / np.maximum((share**2).sum(axis=0), 1e-300)
    return GravityFit(solution[:3] / scale[:3], sigma, segments)


def _integral(rate: Complexes) -> Complexes:
    """Return the integral from the first row to the middle of each."""
    return (np.cumsum(rate) - rate / 2) * ROW_S


def _means_of_seconds(x: NDArray[Any]) -> Complexes:
    return np.asarray(x.reshape(-1, ROWS_A_SECOND).mean(axis=1))
