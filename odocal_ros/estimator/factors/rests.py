# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The standstill factor, docs/method.md (S20): no velocity at keyframes, no turn between."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import Normal
from odocal_ros.estimator.factors.factor import add_prior, add_process, Factor, LinearisationPoint
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import PHI, V
from odocal_ros.nav.rotations import rotvec, transpose

# 1 sigma of a vehicle at rest, at each keyframe m/s, and rad/sqrt(s) about east, north, up.
# Physical, judgement: wind, an engine and people move it on its springs, and tilt it more than
# they turn it
STILL_SPEED, STILL_TURN = 0.005, np.array([1e-4, 1e-4, 2e-5])


class Rests(Factor):
    """Rows of the velocity of keyframes at rest, of the turn of intervals at rest."""

    name = 'rests'

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self.state, self.still = point.state, problem.still
        self.pair = self.still[:-1] & self.still[1:]
        variance = STILL_TURN**2 * point.intervals.T[:, None]
        z2 = (self.turned()**2 / variance).mean(axis=1, keepdims=True)
        self.turn_variance = variance * np.maximum(z2 / TAIL_SIGMAS**2, 1.0)

    def turned(self) -> Floats:
        """Return the turn within each interval, rad: (K, 3)."""
        C = self.state.C_nb
        return rotvec(C[1:] @ transpose(C[:-1]))

    def add(self, out: Normal) -> None:
        weight = self.still[:, None] / STILL_SPEED**2
        add_prior(out, slice(None), V, 1.0, self.state.v_n, weight)
        add_process(out, PHI, 1.0, self.pair[:, None] / self.turn_variance, self.turned())

    def cost(self) -> float:
        total = (self.state.v_n[self.still]**2).sum() / STILL_SPEED**2
        out: float = total + (self.turned()[self.pair]**2 / self.turn_variance[self.pair]).sum()
        return out
