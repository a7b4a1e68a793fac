# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Slow errors of fixes: whether there are any, how large, how long they stay.

A receiver's error wanders over a minute or so. Taken for white it would be averaged as if each fix
brought news, and the sigma would be a fraction of the error. Where the residuals of neighbouring
seconds are alike, or the fixes of a short leg scatter less than they say, a Gauss-Markov part is
estimated beside the white one; its time is one of its levels (slow_error.py).
"""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.smoother.estimate import Fit, fit, Outline, Trace
from odocal_ros.calib.smoother.fixes import Fixes
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.slow_error import USUAL_TIME
from odocal_ros.data.arrays import Floats

WHITE_SHARE = 0.2       # of the variance, beside a slow part of 0.9, to start from: judgement
# times the usual step between fixes, a second at least. Tuned: through a gap of 20 s a jump of
# RTK's height by 3 m bends the pitch by 6 sigmas, through 10 s by 3 (docs/decisions/0009)
GAP = 10.0


def correlation(t: Floats, residual: Floats, width: float = 2.0) -> tuple[float, float]:
    """
    Return the correlation of neighbouring bins of residuals and its sigma, were they white.

    t : (m,) s.   residual : (m, c) in sigmas.   width : of a bin, s.
    """
    if len(t) < 4:
        return 0.0, 1.0
    cell = np.floor((t - t[0]) / width).astype(int)
    at, first = np.unique(cell, return_index=True)
    count = np.diff(np.append(first, len(t)))
    mean = np.add.reduceat(residual, first, axis=0) / np.sqrt(count)[:, None]
    beside = np.flatnonzero(np.diff(at) == 1)
    power = (mean**2).mean()
    if len(beside) < 5 or power == 0:
        return 0.0, 1.0
    return (float((mean[beside] * mean[beside + 1]).mean() / power),
            float(1 / np.sqrt(residual.shape[1] * len(beside))))


def are_slow(problem: Problem, first: Fit) -> bool:
    """Tell whether the errors of the fixes are correlated in time: as set, or by a first fit."""
    if not np.isnan(problem.fix_time):
        return problem.fix_time > 0.0
    if first.levels['fix'] < 0.2**2:        # a fix so much better than it says was filtered
        return True
    t, r = problem.leg.t_fix[problem.use], first.weighted[Fixes].r
    # a fit with slow errors costs time where there are none, one without them the truth of sigmas:
    # 1.5 sigmas, one white leg in 15; of RTK's centimetre little is left to be seen: 0.05. Heights
    # tell of what level places do not only where a receiver comes back at another: 4 sigmas
    for axes, sigmas in ((slice(0, 2), 1.5), (slice(2, 3), 4.0)):
        alike, sigma = correlation(t, r[:, axes])
        if alike > max(0.05, sigmas * sigma):
            return True
    return _hidden(t, first.levels['fix'])


def _hidden(t: Floats, level: float) -> bool:
    """
    Tell whether the fixes of a short leg scatter less than they say.

    In less than 90 s a slow error passes for another scale and heading, and what is left of it
    is hardly alike: what a receiver says of its errors and does not show as scatter is slow, if it
    is beyond 4 sigmas (one white leg in 30 000).

    t : (m,) s.   level : variance of the scatter, of the stated; good to 1 / sqrt(m) of itself,
    two components each.
    """
    out: bool = t[-1] - t[0] < 90.0 and level < 1 - 4 / np.sqrt(len(t))
    return out


def have_gap(problem: Problem) -> bool:
    """
    Tell whether a leg goes on for a while without fixes.

    A receiver may come back elsewhere. The track bends through the gap to meet it, and no residual
    shows that: only a fit in which the fixes may have jumped tells.
    """
    t = problem.leg.t_fix[problem.use]
    return bool(np.diff(t).max(initial=0.0) > GAP * max(1.0, np.median(np.diff(t))))


def with_slow_errors(problem: Problem, first: Outline, trace: Trace | None = None) -> Fit:
    """
    Return the fit with slow fix errors beside the white ones.

    Parameters
    ----------
    problem : Problem
        The leg.
    first : Outline
        A first, rough fit with white fix errors.
    trace : callable, optional
        As for ``fit``.

    """
    time = USUAL_TIME if np.isnan(problem.fix_time) else problem.fix_time
    gain, gain_up = (2 / time * 0.9 * np.median(problem.leg.covariance_n[:, i, i])
                     for i in (0, 2))
    white, up = first.levels['fix'], first.levels['fix_up']
    levels = problem.first_levels.but(
        **problem.shaken, correlation_time=time, slow=gain * white, slow_up=gain_up * up,
        fix=WHITE_SHARE * white, fix_up=WHITE_SHARE * up)
    found = fit(problem, first.state, levels, trace=trace)
    return replace(found, iterations=first.iterations + found.iterations)
