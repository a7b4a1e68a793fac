# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error budget, docs/method.md (S32): each error's share of scale, yaw and pitch."""

import numpy as np

from odocal_ros.calib.budget import root_of
from odocal_ros.calib.result import Source
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.factor import WANTED
from odocal_ros.estimator.factors.priors import PriorRows, SIZES
from odocal_ros.estimator.fit import Fit


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
