# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A heading from outside, docs/method.md (S19): yaw of the IMU's x axis, one error for the leg."""

import numpy as np

from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.least import LEAST
from odocal_ros.estimator.factors.outside_rows import OutsideRows, Rows
from odocal_ros.estimator.outside import Heading
from odocal_ros.estimator.preintegrate import Points
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BARE, BG, GYRO_SCALE, HEADING, M, PHI, State
from odocal_ros.nav.angles import arctan2, wrap


class HeadingRows(OutsideRows):
    """Residuals of a heading (sent less predicted) and their derivatives at one state."""

    name, source = 'heading', 'heading_noise'
    levels_of = {'heading': slice(0, 1)}

    def rows(self, problem: Problem, point: LinearisationPoint) -> Rows:
        """Return the rows."""
        sent = problem.outside['heading']
        assert isinstance(sent, Heading)
        return _heading(sent, point.state, point.points['heading'])

    @staticmethod
    def least(sent: Heading) -> dict[str, float]:
        """Return the least level."""
        return {'heading': (LEAST.heading / float(np.median(sent.noise)))**2}


def _heading(sent: Heading, state: State, points: Points) -> Rows:
    k = points.interval
    C = state.C_nb[k]
    x = (C @ points.R)[:, :, 0]
    level2 = np.maximum(x[:, 0]**2 + x[:, 1]**2, 1e-6)
    raw = wrap(sent.yaw - arctan2(x[:, 1], x[:, 0]) - state.constants[HEADING])
    turns = np.stack([-x[:, 2] * x[:, 0] / level2, -x[:, 2] * x[:, 1] / level2,
                      np.ones(len(k))], -1)
    J, c = np.zeros((len(k), 1, BARE)), np.zeros((len(k), 1, M))
    J[:, 0, PHI] = -turns
    J[:, 0, BG] = np.einsum('ki,kij->kj', turns, C) * points.tau[:, None]
    c[:, 0, GYRO_SCALE] = J[:, 0, BG.start + 2] * points.rate[:, 2]
    c[:, 0, HEADING] = -1.0
    return Rows(k, raw[:, None], J, c, 1 / sent.noise[:, None])
