# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The information of a fit on the constants of its leg, and the errors in it.

The error budget, docs/method.md (S32), has each error's share of scale, yaw and pitch. For other
legs the marginal information is without priors, (S33).
"""

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.calib.budget import root_of
from odocal_ros.calib.result import Source
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.factor import WANTED
from odocal_ros.estimator.factors.priors import PriorRows, SIZES
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.state import CONSTANTS, NO_ERROR, OF_LEG


def shares(fit: Fit, marginals: JointMarginals) -> tuple[Source, ...]:
    """
    Return the error sources of (ln K, yaw, pitch); their covariances add up to the total.

    A unit error in a row moves the estimate by the covariance of the estimate and the unknowns of
    that row, times the row's whitened derivative. The remainder belongs to the standstills.
    """
    parts, solved = fit.weighted.parts, fit.solved.covariance
    covariance: dict[str, np.ndarray] = {}
    for part in parts.values():
        for name, effects in part.effects(marginals):
            flat = np.moveaxis(effects, -2, 0).reshape(WANTED, -1)
            covariance[name] = covariance.get(name, 0.0) + flat @ flat.T
    shared = [Source(name, effects, True)
              for name, effects in fit.weighted[PriorRows].shared_effects(solved)]
    rest = solved[:WANTED, :WANTED] - sum(covariance.values()) - sum(
        s.effects @ s.effects.T for s in shared)
    by_levels = fit.by_levels[:WANTED]
    for name, effects in (('noise_levels', by_levels[:, :-len(SIZES)]),
                          ('imperfection_sizes', by_levels[:, -len(SIZES):])):
        covariance[name] = effects @ effects.T
    own = [Source(name, root_of(value)) for name, value in covariance.items()]
    return (*own, *shared, Source('standstill', root_of(rest)))


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
