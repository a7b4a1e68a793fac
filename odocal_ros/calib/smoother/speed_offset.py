# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Whether a sender of coarse speeds truncates or rounds, where the drive tells.

A leg is fitted with anything between, since the grid does not say. What the drive then finds lies
at one of the two, far from the other, and to know it exactly halves the scale's sigma.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.smoother.estimate import AGAIN_PASSES, Fit, fit, Trace
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.state import Priors, SPEED_OFFSET


def judge_offset(problem: Problem, now: Fit, trace: Trace | None = None) -> Fit:
    """
    Return a fit with the offset of a coarse speed taken as that of truncation or of rounding.

    As it was where the drive does not tell which, 1000 to 1, or where it is neither: 3.5 sigmas
    from the nearer, one sound drive in 2000.
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
    sure = 1e-3 * coarse.step       # as good as exact
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
