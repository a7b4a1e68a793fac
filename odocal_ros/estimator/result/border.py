# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The marginal information of a leg on its constants, without priors: docs/method.md (S33)."""

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.priors import PriorRows, SIZES
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.state import CONSTANTS, NO_ERROR, OF_LEG


def border_of(fit: Fit, configured: Floats) -> Border:
    """
    Return the marginal information of a fit at its last linearisation point.

    The Schur complement of the constants less their priors. Constants that are fixed in the leg
    have no information for other legs.

    configured : (M,) values of the settings that constants are corrections to.
    """
    at, priors = fit.weighted.state.constants, fit.weighted[PriorRows].priors
    reduced, g_reduced = fit.solved.reduced, fit.solved.g_reduced
    # each leg has its own ground and errors of the fixes, with their own priors
    own = np.linalg.solve(reduced[OF_LEG, OF_LEG], reduced[OF_LEG]).T
    g_reduced = g_reduced - own @ g_reduced[OF_LEG]
    reduced = reduced - own @ reduced[OF_LEG]
    weight = 1 / priors.constants**2
    free = priors.constants > NO_ERROR
    free[OF_LEG] = False
    return Border(
        CONSTANTS, at + configured,
        (reduced - np.diag(weight)) * np.outer(free, free),
        (g_reduced + weight * (at - priors.centre)) * free, priors.centre + configured,
        fit.first.constants, priors.constants).with_errors(
            fit.by_levels[:, :-len(SIZES)])     # sizes are of the priors, no data
