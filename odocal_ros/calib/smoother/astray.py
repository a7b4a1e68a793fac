# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Fixes that go astray: a receiver jumps off, and back again seconds or a minute later.

So it does under multipath and without its fixed ambiguities. As a slow error both steps would
have to be free, and with them goes what ties the places before to those after; what jumps by less
would pass for an error that wanders all the time. Odometer and Imu tie them far better: the fixes
in between are left out.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.smoother.estimate import Fit
from odocal_ros.calib.smoother.fixes import Fixes
from odocal_ros.calib.smoother.part import JUMP
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.slip import SLIP_VARIANCE
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.reasons import Code, Reason

LONGEST_ASTRAY = 120.0     # s: judgement, beyond it nothing tells which of two places is right
BACK = 0.5          # of the smaller step: judgement, by how much the place may differ after it


@dataclass(frozen=True)
class Stretch:
    """From one jump to the one back: s since the start mark, m off."""

    begin: float
    end: float
    metres: float


def left_out(problem: Problem, fit: Fit) -> bool:
    """Leave out the fixes that went astray in a fit of a problem; tell whether there are any."""
    return bool(fit.levels.correlation_time) and leave_out(
        problem, _stretches(fit.state.t, fit.state.slow_n, fit.spread[:, JUMP]),
        fit.state.constants)


def leave_out(problem: Problem, stretches: list[Stretch], constants: Floats) -> bool:
    """
    Leave out the fixes of stretches, as if they had not come; tell whether there are any.

    constants : (M,) of which the fixes' delay tells when they were true.
    """
    t = Fixes.times(problem, constants)
    within = [(t > one.begin) & (t < one.end) for one in stretches]
    away: Bools = np.any(within, axis=0) if within else np.zeros(len(t), bool)
    if not away.any() or away.mean() > 0.5:     # most are what the others are measured by
        return False
    problem.use = problem.use.copy()
    problem.use[problem.use] = ~away
    problem.root, problem.kept = problem.root[~away], None
    problem.astray += [one for one, its in zip(stretches, within, strict=True) if its.any()]
    return True


def _stretches(t: Floats, slow_n: Floats, factor: Floats) -> list[Stretch]:
    """
    Return what lies between a jump and the one back, shortest first; each jump is of one alone.

    t : (N,) s.   slow_n : (N, 3) m, slow error.   factor : (N - 1,) on variances of its drive.
    """
    far = np.flatnonzero(factor > SLIP_VARIANCE)
    if not len(far):
        return []
    runs = np.split(far, np.flatnonzero(np.diff(far) > 1) + 1)
    first, last = np.array([(run[0], run[-1] + 1) for run in runs]).T
    size = np.linalg.norm(slow_n[last] - slow_n[first], axis=1)
    found, taken = [], np.zeros(len(runs), bool)
    pairs = [(t[last[b]] - t[first[a]], a, b) for b in range(len(runs)) for a in range(b)]
    for length, i, j in sorted(pairs):
        metres, left = min(size[i], size[j]), np.linalg.norm(slow_n[last[j]] - slow_n[first[i]])
        if length < LONGEST_ASTRAY and not (taken[i] or taken[j]) and left < BACK * metres:
            taken[i] = taken[j] = True
            found.append(Stretch(float(t[first[i]]), float(t[last[j]]), float(metres)))
    return found


def astray_reasons(problem: Problem) -> list[Reason]:
    """Say which fixes were left out."""
    leg, all_ = problem.leg, problem.astray
    if not all_:
        return []
    t = leg.t_fix[problem.within]
    worst = max(all_, key=lambda s: s.metres)
    stretches = 'a stretch' if len(all_) == 1 else f'{len(all_)} stretches'
    return [Reason(Code.FIXES_ASTRAY, f'{len(t) - int(problem.use.sum())} of {len(t)} fixes lie '
                   f'off in {stretches} and are back after it; at worst by {worst.metres:.2g} m '
                   f'at t = {worst.begin:.0f} to {worst.end:.0f} s')]
