# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two wheels and the gyro on one time grid, and a robust linear fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import medians
from odocal_ros.nav.integral import integral_at
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.statistics import GAP_INTERVALS, robust_sigma
from odocal_ros.settings.config import SIDES

Imu = tuple[Floats, Floats, Floats]     # t s, w_b rad/s, f_b m/s^2
# robust sigmas beyond which a row has no weight; statistical: 95 % efficient on normal errors
TUKEY = 4.685


@dataclass(frozen=True, eq=False)
class Pair:
    """Travel of both wheels and the vehicle's turn at the edges of equal cells."""

    t: NDArray[np.float64]        # (n,) s
    left: NDArray[np.float64]     # (n,) scale units
    right: NDArray[np.float64]    # (n,) scale units
    turn: NDArray[np.float64]     # (n,) rad about the vehicle's up axis, with gyro bias
    known: NDArray[np.bool_]      # (n - 1,) cells without a gap
    quantum: float                # scale units
    names: tuple[str, ...] = SIDES

    @property
    def step(self) -> float:
        """Return the length of a cell, s."""
        length: float = self.t[1] - self.t[0]
        return length

    def least_sigma(self, steps: Floats) -> float:
        """Return the least sigma of steps: rounding, and a part of their median."""
        return 0.3 * self.quantum + 1e-4 * float(np.median(np.abs(steps)))


def pair(axle: Sequence[Travel], imu: Imu, between: tuple[float, float], step: float,
         doubt_t: Sequence[float] | Floats = ()) -> Pair | None:
    """
    Return the wheels on a grid of ``step`` s, None with fewer than 20 common cells.

    imu : (t, w_b, f_b), (n,) s, (n, 3), (n, 3).   between : s, the marks.   doubt_t : (d,) s.
    """
    t_imu, w_b, f_b = imu
    left, right = axle
    if min(len(left.t), len(right.t), len(t_imu)) < 2:
        return None
    begin = max(left.t[0], right.t[0], t_imu[0], between[0])
    end = min(left.t[-1], right.t[-1], t_imu[-1], between[1])
    t = begin + step * np.arange(max(0, int((end - begin) / step) + 1))
    if len(t) < 21:
        return None
    up_b = medians(f_b)          # the mean of gravity: roll and pitch of the mounting
    rate = w_b @ (up_b / max(float(np.linalg.norm(up_b)), 1e-9))
    known = np.ones(len(t) - 1, bool)
    for times in (left.t, right.t, t_imu):
        gap = np.diff(times)
        for k in np.flatnonzero(gap > max(GAP_INTERVALS * np.median(gap), 0.2)):
            known &= (t[1:] < times[k]) | (t[:-1] > times[k + 1])
    for at in doubt_t:
        known &= (t[1:] < at - step) | (t[:-1] > at + step)
    return Pair(t, left.at(t), right.at(t), integral_at(t, t_imu, rate), known,
                max(left.quantum, right.quantum),
                tuple(one.name or side for one, side in zip(axle, SIDES, strict=True)))


def robust_fit(A: Floats, y: Floats, floor: float, prior: Sequence[float] | Floats | None = None,
               start: Sequence[float] | Floats | None = None) -> tuple[Floats, Floats, float]:
    """
    Return x of y = A x by least squares with Tukey's weights, its covariance, sigma of a value.

    A, y : (n, k), (n,) design and values.   floor : least sigma of a value.   prior : (k,) sigmas
    of the coefficients about zero, inf: free.   start : (k,) coefficients that fit many rows;
    default: least squares. The sigma is by the median of the residuals.
    """
    size = np.abs(A).max(axis=0)
    size[size == 0] = 1.0
    A = A / size
    weak = np.zeros(A.shape[1]) if prior is None else 1 / (np.asarray(prior) * size)**2
    weight, sigma = np.ones(len(y)), 0.0
    x = np.zeros(A.shape[1]) if start is None else np.asarray(start) * size
    tukey_passes = 20
    for turn in range(tukey_passes):
        if turn or start is not None:
            residual = y - A @ x
            sigma = max(robust_sigma(residual), floor)
            u = residual / (TUKEY * sigma)
            # absolute values first (Huber): without a start Tukey's weights can converge anywhere
            huber = start is None and turn < tukey_passes // 2
            weight = 1 / np.maximum(1.0, 3 * np.abs(u)) if huber else np.where(
                np.abs(u) < 1, (1 - u**2)**2, 0.0)
        H = (A * weight[:, None]).T @ A + np.diag(weak * max(sigma, floor)**2 + 1e-12 * len(y))
        x = np.linalg.solve(H, A.T @ (weight * y))
    return x / size, np.linalg.inv(H) * sigma**2 / np.outer(size, size), sigma
