# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Constants that change within a leg, by a score test of the converged fit: docs/method.md (S27c).

A step of a constant at a time is one more column of the equations: that of the constant, from this
time on. Its estimate with all other unknowns free needs no second fit.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import Solved
from odocal_ros.estimator.equations import Weighted
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.state import LN_K, PITCH, YAW
from odocal_ros.settings.levels import FAULT_SIGMAS

STEP_PLACES = 15       # judgement: times of a step, at equal distances along the path
STEPPING = LN_K, YAW, PITCH      # definition: constants that are tested, the scale first
GRADUAL = 1e-3      # physical: 1 sigma of the change of the scale in a leg as tyres warm up


@dataclass(frozen=True)
class Step:
    """A change of a constant from a time, s, on: its size and sigma, relative or rad."""

    constant: int
    t: float
    size: float
    sigma: float

    @property
    def certain(self) -> bool:
        """Return True if noise does not explain the step."""
        return abs(self.size) > FAULT_SIGMAS * self.sigma


def changes(weighted: Weighted, solved: Solved) -> tuple[Step, ...]:
    """Return the most significant step of each constant that has any; before ``marginals``."""
    rows = weighted[MotionRows]
    path = np.cumsum(np.linalg.norm(rows.motion.displacement, axis=1))
    at = np.searchsorted(path, path[-1] * np.arange(1, STEP_PLACES + 1) / (STEP_PLACES + 1))
    chain, border, square, score = rows.step_sides(at, STEPPING)
    left = 1 / solved.taken - 1      # of the step, if it was shortened: to the minimum
    score -= left * (np.einsum('kil,ki->l', chain, solved.step)
                     + border.T @ solved.step_border[:len(border)])
    taken, _ = solved.products(chain, border)
    of_rows, whole = np.diag(square), square - taken
    information = np.diag(whole).copy()
    scale = slice(STEP_PLACES)
    score[scale], information[scale] = _beside_gradual(score[scale], whole[scale, scale])
    information = information.reshape(len(STEPPING), STEP_PLACES)
    # standing before or after a place, or a constant that no row depends on
    known = information > 1e-9 * of_rows.reshape(information.shape)
    sigma = 1 / np.sqrt(np.where(known, information, np.inf))
    score, t = score.reshape(sigma.shape), weighted.state.t[at]
    most = np.argmax(np.abs(score) * sigma, axis=1)
    return tuple(Step(constant, float(t[k]), float(score[i, k] * sigma[i, k]**2),
                      float(sigma[i, k]))
                 for i, (constant, k) in enumerate(zip(STEPPING, most, strict=True))
                 if sigma[i].any())


def _beside_gradual(score: Floats, information: Floats) -> tuple[Floats, Floats]:
    """Return score and information of each step of the scale, beside a gradual change of it."""
    # quadratic in the path, as a sum of steps at all places, with a prior
    shares = GRADUAL / STEP_PLACES * np.vander(np.linspace(-1.0, 1.0, STEP_PLACES), 2)
    across = information @ shares
    by = np.linalg.solve(np.eye(2) + shares.T @ across,
                         np.column_stack([across.T, shares.T @ score]))
    return score - across @ by[:, -1], np.diag(information) - (across * by[:, :-1].T).sum(axis=1)


