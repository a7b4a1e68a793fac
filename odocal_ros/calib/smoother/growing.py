# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The fit of a leg that grows: each starts from the one before.

It takes over state, noise levels, priors and slips, is extended over what is new, and converges
in two passes. Whether it has found the right minimum is checked against a coarse fit from a cold
start whenever the leg has grown by half.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.failed import raised_if_wild
from odocal_ros.calib.result import MethodResult
from odocal_ros.calib.smoother.chain import NotPositive
from odocal_ros.calib.smoother.estimate import AGAIN_PASSES, Fit, fit, Trace, WarmStart
from odocal_ros.calib.smoother.leg import SmootherLeg
from odocal_ros.calib.smoother.outcome import floored, outcome
from odocal_ros.calib.smoother.problem import NO_ERROR, Problem, SPACING
from odocal_ros.calib.smoother.smoother import best_fit
from odocal_ros.calib.smoother.state import LN_K, PITCH, State, YAW
from odocal_ros.calib.smoother.warm_start import carried, steps_of
from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadData
from odocal_ros.settings.config import Config

# s, judgement: from which keyframes lie twice SPACING apart; its cost: docs/decisions/0005
LONG_LEG = 660.0
# judgement: keyframes of a fit from nothing, which takes ten times the passes
FEW_KEYS = 150
LOOK_PASSES = 2         # judgement: from the last fit; AGAIN_PASSES where that is too few
ANEW_GROWTH = 1.5       # judgement: of the leg, until what is decided once is decided anew
CONFIRM_SIGMAS = 3.0  # statistical: of three values chance reaches it once in 120 at most


@dataclass(frozen=True, eq=False)
class SoFar:
    """
    The result of a fit of the leg so far.

    method : as the leg would come out.   sigmas : (3,) of ln scale, yaw, pitch, rad, of what is
    not determined too.   state : at the keyframes.
    """

    method: MethodResult
    sigmas: Floats
    state: State


class GrowingFit:
    """
    The fit of one leg while it grows.

    cpu_s : tells the seconds of CPU used so far.   ``once_s``: those in the last one for what is
    done ever less often as a leg grows.
    """

    def __init__(self, cpu_s: Callable[[], float]) -> None:
        self._cpu_s = cpu_s
        self.once_s = 0.0
        self._last: WarmStart | None = None
        self._per_effective: dict[str, float] = {}
        self._judged = 0.0       # s of the leg when it was last fit from nothing

    def forget(self) -> None:
        """Make the next fit a cold start."""
        self._last, self.once_s = None, 0.0

    def fit(self, view: SmootherLeg, config: Config, trace: Trace) -> SoFar:
        """
        Return the result of the leg so far.

        view : the leg, what came before in the same frame and more.   trace : called between
        passes; what it raises goes through.   BadData is raised where no fit is found; the next
        one starts from nothing then.
        """
        self.once_s = 0.0
        last, self._last = self._last, None
        try:
            with raised_if_wild():
                best, problem = self._fit(last, view, config, trace)
                if not best.settled:
                    raise BadData('the smoother has not converged on the data so far')
                so_far = _so_far(view, problem, best, config)
        except (NotPositive, np.linalg.LinAlgError, FloatingPointError) as error:
            raise BadData(f'the smoother cannot solve the data so far: {error}') from None
        self._last = WarmStart(best.state, best.levels, best.priors, best.first, best.spread)
        self._per_effective = problem.per_effective
        return so_far

    def _fit(self, last: WarmStart | None, view: SmootherLeg, config: Config,
             trace: Trace) -> tuple[Fit, Problem]:
        duration = view.t_stop - view.t_begin
        spacing = SPACING if duration < LONG_LEG else 2 * SPACING
        problem = Problem.of(view, config, steps_of(view, spacing))
        problem.per_effective = self._per_effective
        begun = None if last is None else carried(last, problem)
        if begun is None:
            begin = self._cpu_s()
            best = best_fit(problem, config, trace)
            self._judged = duration
            if last is not None:      # other cells, as a leg has them each time it doubles
                self.once_s += self._cpu_s() - begin
            return best, problem
        # the levels are let alone until the state is on the new stretch too
        near = fit(problem, begun.state, begun.levels, 1, frozen=True, about=begun,
                   trace=trace).summary()
        best = fit(problem, near.state, near.levels, LOOK_PASSES, about=near, trace=trace)
        if not best.settled or best.creeping:
            best = fit(problem, best.state, best.levels, AGAIN_PASSES, about=best, trace=trace)
        if duration > ANEW_GROWTH * self._judged:
            best = self._confirmed(best, problem, config, trace)
        return best, problem

    def _confirmed(self, best: Fit, problem: Problem, config: Config, trace: Trace) -> Fit:
        """Return the fit if a coarse cold start confirms it, else a new fit."""
        begin = self._cpu_s()
        view = problem.leg
        duration = view.t_stop - view.t_begin
        other = Problem.of(view, config, steps_of(view, max(SPACING, duration / FEW_KEYS)))
        anew = best_fit(other, config, trace)
        self._judged = duration
        if anew.settled:
            problem.per_effective = other.per_effective
            sigma = np.sqrt(np.diag(anew.covariance))
            apart = np.abs(anew.state.constants - best.state.constants)[:3] / sigma[:3]
            if apart.max() > CONFIRM_SIGMAS:
                best = best_fit(problem, config, trace)
        self.once_s += self._cpu_s() - begin
        return best


def _so_far(view: SmootherLeg, problem: Problem, best: Fit, config: Config) -> SoFar:
    method = outcome(view, problem, best, config)
    covariance = floored(best.covariance * method.details['widened']**2)
    sigmas: Floats = np.sqrt(np.diag(covariance))[[LN_K, YAW, PITCH]]
    # an angle that is as set is none that the drive knows
    sigmas[best.first.constants[[LN_K, YAW, PITCH]] <= NO_ERROR] = np.inf
    found = dict(method.estimates)
    for name, sigma in zip(PARAMETERS, sigmas, strict=True):
        e = found[name]
        if e.value is not None:
            factor = abs(e.value) if name == PARAMETERS[0] else 1.0
            found[name] = replace(e, sigma=float(sigma * factor))
    return SoFar(replace(method, estimates=found), sigmas, best.state)
