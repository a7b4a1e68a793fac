# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Score test for a step of scale, yaw or pitch within a leg, at the converged fit: (S27c).

A constant with a step has one more column C of derivatives: that of the constant in the rows of
``MotionRows`` after the step, zero before it. J, R, r and H are those of the fit, docs/method.md.
With all other unknowns free,

    score = -C' R^-1 r,    information = C' R^-1 C - g' H^-1 g,    g = J' R^-1 C

estimate the step, score / information, and its sigma, information^-1/2, without a second fit.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import blocks, Floats, Ints, runs, work_array
from odocal_ros.estimator.chain import Solution
from odocal_ros.estimator.equations import WeightedEquations
from odocal_ros.estimator.factors.factor import IMU
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.state import LN_K, PHI, PITCH, YAW
from odocal_ros.settings.levels import FAULT_SIGMAS

STEP_PLACES = 15        # judgement: places where steps are tested, at equal distances on the path
TESTED_CONSTANTS = LN_K, YAW, PITCH      # definition: for steps; the scale first
# judgement: root of the variance factor of a large outlier of the gyro, and smallest turn, rad,
# that only the gyro measured. In three real drives it is at most 0.02 deg
GYRO_OUTLIER, MIN_GYRO_TURN = 5.0, np.deg2rad(0.3)
WARMING_CHANGE = 1e-3      # physical: 1 sigma of the change of the scale in a leg as tyres warm up


@dataclass(frozen=True)
class ConstantStep:
    """A step of a constant within a leg."""

    constant: int   # index in CONSTANTS
    t: float        # s since the start mark
    size: float     # relative or rad, value after t minus value before
    sigma: float

    @property
    def is_certain(self) -> bool:
        """Return True if noise does not explain the step."""
        return abs(self.size) > FAULT_SIGMAS * self.sigma


def find_constant_steps(weighted: WeightedEquations,
                        solution: Solution) -> tuple[ConstantStep, ...]:
    """Return the most significant step of each constant; call before ``solution.marginals``."""
    rows = weighted[MotionRows]
    path = np.cumsum(np.linalg.norm(rows.motion.displacement, axis=1))
    first = np.searchsorted(path, path[-1] * np.arange(1, STEP_PLACES + 1) / (STEP_PLACES + 1))
    score, matrix, upper_limit = _scores(rows, solution, first)
    information = np.diag(matrix).copy()
    scale = slice(STEP_PLACES)
    score[scale], information[scale] = _with_gradual_change(score[scale], matrix[scale, scale])
    # no information: at rest before or after the place, or a constant that no row depends on
    has_information = information > 1e-9 * upper_limit
    shape = len(TESTED_CONSTANTS), STEP_PLACES
    sigma = (1 / np.sqrt(np.where(has_information, information, np.inf))).reshape(shape)
    score, t = score.reshape(shape), weighted.state.t[first]
    largest = np.argmax(np.abs(score) * sigma, axis=1)
    size = score * sigma**2
    steps = [ConstantStep(constant, float(t[k]), float(size[i, k]), float(sigma[i, k]))
             for i, (constant, k) in enumerate(zip(TESTED_CONSTANTS, largest, strict=True))
             if sigma[i].any()]
    turn = _turn_of_imu(weighted)
    return tuple(turn if turn and step.constant == YAW and abs(turn.size) > abs(step.size)
                 else step for step in steps)


def _turn_of_imu(weighted: WeightedEquations) -> ConstantStep | None:
    """Return the largest turn that only the gyro measured as a step of the yaw, None without."""
    # the IMU turned on the vehicle; the fit may keep the yaw, and call the gyro an outlier
    rows = weighted[MotionRows]
    turn = np.einsum('ki,ki->k', rows.motion.residual[:, PHI], rows.noise.axes[:, 2])
    outliers = runs(rows.noise.imu[:, IMU.index('gyro')] > GYRO_OUTLIER)
    turns = [(float(turn[begin:end].sum()), begin, end) for begin, end in outliers]
    size, begin, end = max(turns, key=lambda x: abs(x[0]), default=(0.0, 0, 0))
    if abs(size) < MIN_GYRO_TURN:
        return None
    sigma = np.sqrt(weighted.levels['gyro'] * rows.motion.T[begin:end].sum())
    return ConstantStep(YAW, float(weighted.state.t[begin]), -size, float(sigma))


def _scores(rows: MotionRows, solution: Solution, first: Ints) -> tuple[Floats, Floats, Floats]:
    """
    Return the scores of L steps, (L,), their information, (L, L), and its upper limit, (L,).

    first : intervals in which steps begin. The steps of a constant are adjacent.
    """
    n, L = rows.n, len(TESTED_CONSTANTS) * len(first)
    g, g_constants = work_array(len(rows.r) + 1, n, L), np.zeros((rows.m, L))
    products, score = np.zeros((L, L)), np.zeros(L)
    for chunk in blocks(len(rows.r)):
        J, ends = rows.J[chunk], slice(chunk.start + 1, chunk.stop + 1)
        is_after = np.arange(chunk.start, chunk.stop)[:, None] >= first
        C = (J[:, :, [2 * n + i for i in TESTED_CONSTANTS], None] * is_after[:, None, None]
             ).reshape(*J.shape[:2], L)
        J_C = np.swapaxes(J, 1, 2) @ C
        g[chunk] += J_C[:, :n]
        g[ends] += J_C[:, n:2 * n]
        g_constants += J_C[:, 2 * n:].sum(axis=0)
        products += (np.swapaxes(C, 1, 2) @ C).sum(axis=0)
        score -= np.einsum('kil,ki->l', C, rows.r[chunk])
    # a shortened step of the fit ends before the minimum of the equations: move the scores to it
    to_minimum = 1 / solution.step_fraction - 1
    score -= to_minimum * (np.einsum('kil,ki->l', g, solution.step)
                           + g_constants.T @ solution.step_constants[:len(g_constants)])
    return score, products - solution.quadratic_forms(g, g_constants)[0], np.diag(products)


def _with_gradual_change(score: Floats, information: Floats) -> tuple[Floats, Floats]:
    """
    Return score and information of each step of the scale if it also changes gradually: (L,) each.

    Equal steps at all places are a linear change over the path, steps that grow linearly a
    quadratic one. Both have a prior sigma, WARMING_CHANGE, and are eliminated (Schur complement).
    """
    growth = np.linspace(-1.0, 1.0, STEP_PLACES)
    sigmas = WARMING_CHANGE / STEP_PLACES * np.stack([growth, np.ones(STEP_PLACES)], -1)
    cross = information @ sigmas
    solution = np.linalg.solve(np.eye(2) + sigmas.T @ cross,
                               np.column_stack([cross.T, sigmas.T @ score]))
    return (score - cross @ solution[:, -1],
            np.diag(information) - (cross * solution[:, :-1].T).sum(axis=1))
