# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Priors that the data contradict: docs/method.md (S30)."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals, Solved
from odocal_ros.estimator.state import BA, BG, FIX_TIME, IMPERFECT, Priors, SPEED_OFFSET, State

# sigmas of a prior beyond which it is relaxed. Statistical: one sound prior in 22
RELAXED_BEYOND = 2.0


def relaxed(first: Priors, now: Priors, state: State, solved: Solved,
            marginals: JointMarginals) -> Priors:
    """
    Return priors widened where the data are far from their centre, docs/method.md (S30).

    Those of imperfections stay: their sizes are levels.
    """
    n = solved.step.shape[1]
    P0 = np.diagonal(marginals[0])[:n]
    variance = np.diag(solved.covariance)
    constants = _wider(first.constants, now.constants, state.constants - first.centre, variance)
    constants[IMPERFECT] = now.constants[IMPERFECT]       # their sizes are levels
    # the grid holds that offset; times are of receivers as they are made
    held = [SPEED_OFFSET, FIX_TIME]
    constants[held] = now.constants[held]
    return replace(
        now,
        gyro_bias=_wider(first.gyro_bias, now.gyro_bias, state.gyro_bias[0], P0[BG]),
        accel_bias=_wider(first.accel_bias, now.accel_bias, state.accel_bias[0], P0[BA]),
        constants=constants)


def _wider(first: Floats, now: Floats, off: Floats, variance: Floats) -> Floats:
    """
    Return sigmas for which ``off`` is at most RELAXED_BEYOND sigmas, none below the first.

    At most 30 times the first: a larger difference is a wrong setting, which is reported.
    """
    held = np.isfinite(first)
    first_, now_ = np.where(held, first, 1.0), np.where(held, now, 1.0)
    z2 = off**2 / np.maximum(now_**2 - variance, 0.2 * now_**2)
    wide = np.clip(now_ * np.sqrt(z2) / RELAXED_BEYOND, first_, 30 * first_)
    return np.where(held, wide, np.inf)
