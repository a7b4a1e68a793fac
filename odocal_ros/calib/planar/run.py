# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Input and result of the planar estimator: wheels of a robot, positions, prior knowledge, fit.

``Wheels`` has the kinematics. A body increment is the motion of base_link in an interval: forward,
m, left, m, and turn, rad, counter-clockwise.
"""

from dataclasses import dataclass, field

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.settings.config import MECANUM, OMNI, SKID

# definition: rows: wheels; columns: wheel travel per metre forward, per metre left, and per metre
# of lever times turn. Lever: half the track width; mecanum: plus half the wheelbase
SIDE_ROWS = np.array([[1.0, 0.0, -1.0], [1.0, 0.0, 1.0]])
# definition: front left, front right, rear left, rear right
MECANUM_ROWS = np.array([[1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0]])
# relative, prior sigma of wheel differences if a robot moves sideways. Judgement, measured:
# docs/decisions/0024
WHEEL_DIFFERENCE = 0.03


def wheel_rows(kind: str, count: int, offset: float = 0.0) -> Floats:
    """
    Return the rows of the wheels of a drive: (w, 3).

    kind : as odometer.drive.   count : of omni wheels, counter-clockwise.   offset : rad from x to
    the first; positive motion is clockwise about the middle, as in omni_wheel_drive_controller.
    """
    if kind == MECANUM:
        return MECANUM_ROWS
    if kind == OMNI:
        angle = offset + 2 * np.pi * np.arange(count) / count
        return np.stack([np.sin(angle), -np.cos(angle), -np.ones(count)], -1)
    return SIDE_ROWS


@dataclass(frozen=True, eq=False)
class Wheels:
    """Increments of w wheels in n intervals."""

    count: Floats  # (n, w) scale units; differential and skid drives: the means of both sides
    rows: Floats   # (w, 3) of ``wheel_rows``, whose columns are orthogonal
    kind: str      # as odometer.drive

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the constants in the order of ``increments``."""
        wheels = self.count.shape[1]
        scales = ('left', 'right') if wheels == len(SIDE_ROWS) else tuple(
            f'wheel_{k}' for k in range(1, wheels + 1))
        return (*scales, 'inverse_track_width',
                *{SKID: ('arc',), MECANUM: ('lateral',)}.get(self.kind, ()))

    @property
    def wheels_to_body(self) -> Floats:
        """Return pseudo-inverse of ``rows``, (3, w): wheels to forward, left, width times turn."""
        shares: Floats = self.rows / np.maximum((self.rows**2).sum(0), 1e-12)
        return np.asarray((shares * np.array([1.0, 1.0, 2.0])).T)

    def body_motion(self, metres: Floats) -> Floats:
        """Return forward, left, track width times turn, (n, 3) m, from wheel travel, (n, w) m."""
        # not by BLAS: its last bits depend on the number of rows
        return np.asarray(np.einsum('kw,iw->ki', metres, self.wheels_to_body))

    @property
    def path(self) -> Floats:
        """Return the path of a wheel, mean of both sides, plus sideways motion: (n,)."""
        forward, sideways, wheel_difference = self.body_motion(self.count).T
        rolled = np.maximum(np.abs(forward), np.abs(wheel_difference) / 2)
        return np.asarray(rolled + np.abs(sideways))

    @property
    def turns_on_spot(self) -> Bools:
        """Return True for intervals with more turn than travel: (n,)."""
        forward, sideways, wheel_difference = np.abs(self.body_motion(self.count)).T
        return np.asarray(wheel_difference > 2 * (forward + sideways))

    @property
    def straightness(self) -> Floats:
        """Return 0 for a turn on the spot, 1 - width / (2 radius) on an arc: (n,)."""
        forward, _, wheel_difference = np.abs(self.body_motion(self.count)).T
        larger = np.maximum(2 * forward, wheel_difference)
        return 1 - np.where(larger > 0, wheel_difference / np.maximum(larger, 1e-30), 1.0)

    def increments(self, constants: Floats) -> tuple[Floats, Floats]:
        """
        Return forward, left and turn of each interval, (n, 3) m, m, rad, and derivatives.

        constants : (m,) scale of each wheel; 1 / track width (twice the lever); skid: increase of
        1 / width from turns on the spot to a straight line; mecanum: ratio of sideways motion to
        rolled path.   derivatives : by constants, (n, 3, m).
        """
        w, wheels_to_body = self.count.shape[1], self.wheels_to_body
        scale, inverse_width, lateral_ratio = self._split_constants(constants)
        forward, rolled, wheel_difference = self.body_motion(self.count * scale).T
        J = np.zeros((len(self.count), 3, len(self.names)))
        J[:, 0, :w] = self.count * wheels_to_body[0]
        J[:, 1, :w] = self.count * wheels_to_body[1] * lateral_ratio
        J[:, 2, :w] = self.count * wheels_to_body[2] * inverse_width[:, None]
        J[:, 2, w] = wheel_difference
        if self.kind == SKID:
            J[:, 2, w + 1] = wheel_difference * self.straightness
        if self.kind == MECANUM:
            J[:, 1, w + 1] = rolled
        return np.stack([
            forward, rolled * lateral_ratio, wheel_difference * inverse_width], -1), J

    def _split_constants(self, constants: Floats) -> tuple[Floats, Floats, float]:
        """Return scales (w,), inverse widths (n,), ratio of sideways motion to rolled path."""
        w, n = self.count.shape[1], len(self.count)
        inverse_width = np.full(n, constants[w]) + (
            constants[w + 1] * self.straightness if self.kind == SKID else 0.0)
        lateral_ratio = float(constants[w + 1]) if self.kind == MECANUM else 1.0
        return constants[:w], inverse_width, lateral_ratio

    def gains(self, constants: Floats) -> tuple[Floats, Floats]:
        """
        Return the body motion (forward, left, turn) per count of wheel slip, and its derivatives.

        (n, 3) and, by constants, (n, 3, m). Residuals are divided by it, so that wheel noise does
        not bias the scales (errors in variables).
        """
        w = self.count.shape[1]
        scales, inverse_width, lateral_ratio = self._split_constants(constants)
        scale = scales.sum() / w
        J = np.zeros((len(self.count), 3, len(self.names)))
        J[:, 0, :w], J[:, 1, :w] = 1 / w, lateral_ratio / w
        J[:, 2, :w] = inverse_width[:, None] / w
        J[:, 2, w] = scale
        if self.kind == SKID:
            J[:, 2, w + 1] = scale * self.straightness
        if self.kind == MECANUM:
            J[:, 1, w + 1] = scale
        return np.stack([np.full_like(inverse_width, scale),
                         np.full_like(inverse_width, scale * lateral_ratio),
                         inverse_width * scale], -1), J

    def prior(self, left: float, right: float, width: float) -> tuple[Floats, Floats]:
        """Return prior values (m,) and covariance (m, m) from the first values of a run."""
        wide_sigma = 0.35     # relative, judgement: too wide to affect any run with a result
        w, scale = self.count.shape[1], (left + right) / 2
        scales = [left, right] if w == len(SIDE_ROWS) else [scale] * w
        # value and sigma of the constant of the kind of drive, if it has one
        additional = {SKID: [(0.0, 1 / width)], MECANUM: [(1.0, 1.0)]}.get(self.kind, [])
        covariance = np.diag([(wide_sigma * scale)**2] * w + [
            width**-2.0, *(sigma**2 for _, sigma in additional)])
        if w > len(SIDE_ROWS):
            covariance[:w, :w] = scale**2 * (wide_sigma**2 + WHEEL_DIFFERENCE**2 * np.eye(w))
        return np.array([*scales, 1 / width, *(value for value, _ in additional)]), covariance


def make_side_wheels(left: Floats, right: Floats, kind: str) -> Wheels:
    """Return the wheels of a differential robot or skid steering: (n,) of each side."""
    return Wheels(np.stack([left, right], -1), SIDE_ROWS, kind)


@dataclass(frozen=True, eq=False)
class Run:
    """Measurements of a run, on n + 1 nodes in time."""

    t: Floats         # (n + 1,) s
    wheels: Wheels    # increments between nodes
    node: Ints        # (k,) nodes with a position
    position: Floats  # (k, 2) m
    sigma: Floats     # (k,) m, stated white error
    # (n,) rad, turn between nodes by the gyro; empty: no gyro
    gyro: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class PriorKnowledge:
    """Prior knowledge of a run; sigmas are 1 sigma, in SI units."""

    # m, track width; 0: unknown. If the fit has several minima, the one nearest to it is used
    width: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)  # m, tracked point ahead and left of the wheels
    offset_sigma: float = 0.1
    delay_sigma: float = 0.05
    drift_length: float = 10.0  # m of path, correlation length of position errors
    gyro_noise: float = 1e-4    # rad/sqrt(s)
    gyro_scale_sigma: float = 0.02
    gyro_bias_sigma: float = 0.01


@dataclass(frozen=True, eq=False)
class Fit:
    """Estimate of a run: m constants, n + 1 poses and noise levels."""

    names: tuple[str, ...]    # of the constants
    value: Floats             # (m,)
    covariance: Floats        # (m, m)
    pose: Floats              # (n + 1, 3) m, m, rad
    levels: dict[str, float]  # sigma of each noise, in the units of ``fit.LEVELS``
    passes: int               # number of passes
    converged: bool           # False at the limit of passes
    swapped: bool             # left and right wheels are swapped
