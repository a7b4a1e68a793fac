# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Kinematics: body increments of a robot from the increments of its wheels."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.settings.config import DIFFERENTIAL, MECANUM, SKID

# judgement: the turn of a mecanum robot by sideways motion, by unequal wheels, 1 sigma
CROSS_SIGMA = 0.05


@dataclass(frozen=True, eq=False)
class Wheels:
    """
    Increments of the wheels in n intervals, in scale units.

    left, right : (n,) mean of the wheels of a side.   lateral : (n,) sideways motion of a mecanum
    robot, (-fl + fr + rl - rr) / 4; zero of others.   kind : as odometer.drive.
    """

    left: Floats
    right: Floats
    lateral: Floats
    kind: str = DIFFERENTIAL

    @property
    def names(self) -> tuple[str, ...]:
        """Return the constants in the order of ``increments``."""
        return ('left', 'right', 'curvature', *{SKID: ('arc',), MECANUM: ('lateral', 'cross')}
                .get(self.kind, ()))

    @property
    def path(self) -> Floats:
        """Return the path of a wheel, mean of both sides, and to the side: (n,)."""
        path: Floats = (np.abs(self.left) + np.abs(self.right)) / 2 + np.abs(self.lateral)
        return path

    @property
    def spins(self) -> Bools:
        """Return True for intervals with more turn than travel: (n,)."""
        spins: Bools = np.abs(self.right - self.left) > np.abs(
            self.left + self.right) + 2 * np.abs(self.lateral)
        return spins

    @property
    def straightness(self) -> Floats:
        """Return 0 for a turn on the spot, 1 - width / (2 radius) on an arc: (n,)."""
        both = np.abs(self.left + self.right)
        apart = np.abs(self.right - self.left)
        most = np.maximum(both, apart)
        return 1 - np.where(most > 0, apart / np.maximum(most, 1e-30), 1.0)

    def increments(self, c: Floats) -> tuple[Floats, Floats]:
        """
        Return forward, left and turn of each interval, (n, 3) m, m, rad, and derivatives by c.

        c : (m,) scale of the left and of the right side, one over the track width; of skid
        steering the increase of the latter from the spot to a straight line; of mecanum wheels
        the lateral scale, and the turn by sideways motion.
        """
        left, right, zero = self.left, self.right, np.zeros_like(self.left)
        apart = c[1] * right - c[0] * left
        share = self.straightness if self.kind == SKID else zero
        by = c[2] + (c[3] * share if self.kind == SKID else zero)
        forward, side, turn = (c[0] * left + c[1] * right) / 2, zero, apart * by
        J = [(left / 2, zero, -left * by), (right / 2, zero, right * by), (zero, zero, apart)]
        if self.kind == SKID:
            J.append((zero, zero, apart * share))
        if self.kind == MECANUM:
            side, turn = c[3] * self.lateral, turn + c[4] * self.lateral
            J += [(zero, self.lateral, zero), (zero, zero, self.lateral)]
        return np.stack([forward, side, turn], -1), np.stack([np.stack(j, -1) for j in J], -1)

    def gains(self, c: Floats) -> tuple[Floats, Floats]:
        """
        Return forward, left and turn of each interval by its wheels, (n, 3), and derivatives by c.

        Slip is an error of the wheels: residuals of a body increment are divided by its gain, so
        that the noise of a wheel does not bias its factor (errors in variables).
        """
        n, m = len(self.left), len(self.names)
        scale, share = (c[0] + c[1]) / 2, self.straightness
        by = np.full(n, c[2]) + (c[3] * share if self.kind == SKID else 0.0)
        J = np.zeros((n, 3, m))
        J[:, 0, :2] = 0.5
        J[:, 1, 3 if self.kind == MECANUM else slice(0, 2)] = (
            1.0 if self.kind == MECANUM else 0.5)
        J[:, 2, :2], J[:, 2, 2] = by[:, None] / 2, scale
        if self.kind == SKID:
            J[:, 2, 3] = scale * share
        side = c[3] if self.kind == MECANUM else scale
        return np.stack([np.full(n, scale), np.full(n, side), by * scale], -1), J

    def prior(self, left: float, right: float, width: float) -> tuple[Floats, Floats]:
        """Return first values and sigmas of the constants by the first values of a run."""
        wide = 0.35     # relative, judgement: no information for any run with a result
        scale = (left + right) / 2
        value = {'left': left, 'right': right, 'curvature': 1 / width, 'arc': 0.0,
                 'lateral': scale, 'cross': 0.0}
        sigma = {'left': wide * scale, 'right': wide * scale, 'curvature': 1 / width,
                 'arc': 1 / width, 'lateral': scale, 'cross': CROSS_SIGMA * scale / width}
        return (np.array([value[n] for n in self.names]), np.array([sigma[n] for n in self.names]))
