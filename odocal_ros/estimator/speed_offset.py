# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Test whether a coarse speed is truncated or rounded.

A leg is fitted with any offset between the two. If the estimate is close to one of them and far
from the other, this one is used: the scale sigma is then half as large.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.estimator.fit import AGAIN_PASSES, Fit, fit, Trace
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import Priors, SPEED_OFFSET


def judge_offset(problem: Problem, now: Fit, trace: Trace | None = None) -> Fit:
    """
    Return a fit with the offset of a coarse speed fixed to that of truncation or of rounding.

    Unchanged if the likelihood ratio is below 1000 to 1, or if the nearer one is 3.5 sigmas off
    (one correct drive in 2000).
    """
    coarse = problem.leg.travel.coarse
    if coarse is None or not coarse.truncation:
        return now
    sigma = float(np.sqrt(now.solved.covariance[SPEED_OFFSET, SPEED_OFFSET]))
    found = float(now.state.constants[SPEED_OFFSET])
    known = coarse.truncation if found > coarse.truncation / 2 else 0.0
    off, other = (abs(found - x) / sigma for x in (known, coarse.truncation - known))
    if off > 3.5 or other**2 - off**2 < 2 * np.log(1e3):
        return now
    constants = now.state.constants.copy()
    constants[SPEED_OFFSET] = known
    summary = now.summary()
    del now             # the equations of one fit at a time
    sure = 1e-3 * coarse.step       # practically fixed
    about = replace(summary, priors=_held(summary.priors, known, sure),
                    first=_held(summary.first, known, sure))
    last = fit(problem, replace(about.state, constants=constants), about.levels, AGAIN_PASSES,
               about=about, frozen=True, trace=trace)
    return replace(last, iterations=about.iterations + last.iterations)


def _held(priors: Priors, value: float, sigma: float) -> Priors:
    """Return priors with the offset known."""
    constants, centre = priors.constants.copy(), priors.centre.copy()
    constants[SPEED_OFFSET], centre[SPEED_OFFSET] = sigma, value
    return replace(priors, constants=constants, centre=centre)
