# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
What the smoother makes of the way so far: run on the thinned of a leg, each look from the last.

A look starts from the state, noise levels, priors and slips that the one before ended with,
reckons on over what is new, and is there after two passes. The accelerometer's scale error is
judged on the way. What is decided once for a leg, the sort of fix errors and where the Imu faces,
is decided anew from nothing whenever the leg has grown by half.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
import time

import numpy as np

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.failed import told_if_wild
from odocal_ros.calib.result import MethodResult
from odocal_ros.calib.smoother import smoother_leg
from odocal_ros.calib.smoother.chain import NotPositive
from odocal_ros.calib.smoother.estimate import fit, WarmStart
from odocal_ros.calib.smoother.imperfect import judge_imperfect, judge_running, with_imperfect
from odocal_ros.calib.smoother.leg import SmootherLeg
from odocal_ros.calib.smoother.outcome import floored, outcome
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.remarks import model_floor
from odocal_ros.calib.smoother.smoother import best_fit, likeliest_fit, too_little
from odocal_ros.calib.smoother.state import IMPERFECT, LN_K, PITCH, YAW
from odocal_ros.calib.smoother.warm_start import carried, rows_of
from odocal_ros.data.leg import Leg
from odocal_ros.errors import BadData
from odocal_ros.foresee.forecast import Abandoned
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.standstill import standstills
from odocal_ros.pipeline.calibrate import turned_over
from odocal_ros.screening.facing import axes_reasons, facing
from odocal_ros.screening.placed import place
from odocal_ros.screening.sanity import imu_sanity, UNUSABLE
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

FINE_SPACING, COARSE_SPACING = 1.0, 2.0# s between keyframes, of a leg up to LONG_LEG and beyond
LONG_LEG = 660.0                   # s
FEW_KEYS = 150                     # keyframes of a fit from nothing: it takes ten times the passes
LOOK_PASSES, MORE_PASSES = 2, 6    # from the last look, and where that was not enough
ANEW_GROWTH = 1.5                  # of the leg, until what is decided once is decided anew
BEARS_OUT_SIGMAS = 3.0    # sigmas within which a fit from nothing bears the running one out


@dataclass(frozen=True, eq=False)
class Running:
    """
    The running estimate.

    method : as the leg would come out, ended here.   sigmas : (3,) of ln scale, yaw, pitch, rad,
    of what is not determined too.   distance : m.   agility : m^2/s^3, square of the horizontal
    acceleration summed up.   speed : m/s, usual.
    """

    method: MethodResult
    sigmas: np.ndarray
    distance: float
    agility: float
    speed: float


class SmootherSoFar:
    """
    The smoother on one leg while it grows.

    ``once_s``: seconds of CPU in the last look for what is done ever less often as a leg grows.
    """

    def __init__(self) -> None:
        self.once_s = 0.0
        self._last: WarmStart | None = None
        self._origin: Origin | None = None
        self._thin: dict = {}
        self._judged = 0.0       # s of the leg when it was last fit from nothing

    def look(self, leg: Leg, config: Config, wanted: Callable[[], bool] = lambda: True) -> Running:
        """
        Return the running estimate.

        Parameters
        ----------
        leg : Leg
            The way so far: what came before, and more.
        config : Config
            As frozen into the leg.
        wanted : callable
            Asked between passes; Abandoned is raised when it says no.

        Raises
        ------
        OdocalError
            Too little of the drive yet, or no fit to it; the next look starts from nothing.

        """
        def trace(*_):
            if not wanted():
                raise Abandoned

        self.once_s = 0.0
        try:
            view = self._view(leg, config)
            with told_if_wild():
                best, problem = self._fit(view, config, trace)
                running = _running(view, problem, best, config) if best.settled else None
        except (NotPositive, np.linalg.LinAlgError, FloatingPointError) as error:
            self._last = None
            raise BadData(f'the smoother cannot solve the way so far: {error}') from None
        except BaseException:
            self._last = None
            raise
        if running is None:
            self._last = None
            raise BadData('the smoother has not settled on the way so far')
        self._last = WarmStart(best.state, best.levels, best.priors, best.first, best.spread)
        self._thin = problem.per_effective
        return running

    def _view(self, leg, config) -> SmootherLeg:
        inputs, _ = screen(leg, config)
        if len(inputs.t_imu) < 4 or len(inputs.travel.t) < 2:
            raise BadData('the smoother needs samples of the Imu and of the odometer')
        if not inputs.felt:
            raise BadData('the smoother needs an accelerometer')
        few = too_little(len(inputs.t_fix), float(inputs.t_imu[-1] - inputs.t_imu[0]))
        if few:
            raise BadData(few.text)
        found, z_down = imu_sanity(inputs.usual_f_b, inputs.w_b, inputs.C_bi, config.imu)
        _refuse_unusable(found)
        inputs = turned_over(inputs) if z_down else inputs
        placed = place(inputs, config)
        if not placed.rough:
            raise BadData('how far a count reaches is not known yet')
        _refuse_unusable(axes_reasons(
            facing(inputs, placed.rough), config.imu.nominal_yaw))
        if vars(placed.origin) != (self._origin and vars(self._origin)):
            self._origin, self._last = placed.origin, None
        spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, placed.rough,
                            config.leg.standstill)
        # a way beyond the odometer's last row would be a slip
        t_stop = min(inputs.t_stop, float(inputs.travel.t[-1]))
        view = smoother_leg(inputs, config, placed.origin, placed.fixes_n, spans,
                            placed.rough, t_stop)
        fixes = ((view.t_fix >= view.t_begin) & (view.t_fix <= view.t_stop)).sum()
        few = too_little(int(fixes), float(view.t_imu[-1] - view.t_begin))
        if few:
            raise BadData(few.text)
        return view

    def _fit(self, view, config, trace):
        duration = view.t_stop - view.t_begin
        spacing = FINE_SPACING if duration < LONG_LEG else COARSE_SPACING
        problem = Problem.of(view, config, rows_of(view, spacing))
        problem.per_effective = self._thin
        begun = None if self._last is None else carried(self._last, problem)
        if begun is None:
            begin = time.thread_time()
            best = best_fit(problem, config, trace)
            self._judged = duration
            if self._last is not None:      # other cells, as a leg has them each time it doubles
                self.once_s += time.thread_time() - begin
            return best, problem
        # the levels are let alone until the state is on the new stretch too
        best = fit(problem, begun.state, begun.levels, 1, frozen=True, about=begun, trace=trace)
        best = judge_running(best, problem.grade).outline()     # more of a drive tells more of it
        best = fit(problem, best.state, best.levels, LOOK_PASSES, about=best, trace=trace)
        if not best.settled:
            best = fit(problem, best.state, best.levels, MORE_PASSES, about=best, trace=trace)
        if duration > ANEW_GROWTH * self._judged:
            best = self._borne_out(best, problem, config, trace)
        return best, problem

    def _borne_out(self, best, problem, config, trace):
        """Return the fit as a coarse one from nothing bears it out, else one from nothing."""
        begin = time.thread_time()
        view = problem.leg
        duration = view.t_stop - view.t_begin
        other = Problem.of(view, config, rows_of(view, max(FINE_SPACING, duration / FEW_KEYS)))
        anew = likeliest_fit(other, config, trace)
        self._judged = duration
        if anew.settled:
            problem.per_effective = other.per_effective
            best = _decided_anew(best, anew, problem, config, trace)
        self.once_s += time.thread_time() - begin
        return best


def _decided_anew(best, anew, problem, config, trace):
    """Return a fit with the fix errors of another, and judged as one from nothing is."""
    slow = anew.levels.correlation_time or best.levels.correlation_time
    none = with_imperfect(best.first, problem.priors.constants[IMPERFECT])
    unjudged = (none.constants == best.first.constants).all()
    state, levels = best.state, best.levels
    if slow:
        fixes = {name: anew.levels[name] for name in ('fix', 'fix_up', 'slow', 'slow_up')}
        levels = levels.but(correlation_time=anew.levels.correlation_time, **fixes)
    if not levels.correlation_time:
        state = replace(state, slow_n=np.zeros_like(state.slow_n))
    if slow or not unjudged:
        about = replace(best, first=none, priors=with_imperfect(
            best.priors, problem.priors.constants[IMPERFECT]))
        best = fit(problem, state, levels, MORE_PASSES, about=about, trace=trace)
    sigma = np.sqrt(np.diag(anew.solved.covariance))
    apart = np.abs(anew.state.constants - best.state.constants)[:3] / sigma[:3]
    if apart.max() > BEARS_OUT_SIGMAS:
        return best_fit(problem, config, trace)
    return judge_imperfect(problem, best, trace)


def _refuse_unusable(found):
    why = [r.text for r in found if r.code in UNUSABLE]
    if why:
        raise BadData(why[0])


def _running(view, problem, best, config) -> Running:
    method = outcome(view, problem, best, config)
    state = best.state
    T, steps = np.diff(state.t), np.linalg.norm(np.diff(state.p_n, axis=0), axis=1)
    moving = steps > 0.5 * T
    way = max(float(steps.sum()), 1.0)
    covariance = floored(best.solved.covariance * method.details['widened']**2,
                         model_floor(state.constants, best.priors.constants))
    sigmas = np.sqrt(np.diag(covariance))[[LN_K, YAW, PITCH]]
    sigmas[0] = np.hypot(sigmas[0], _of_cells(view, problem.imu))
    found = dict(method.estimates)
    for name, sigma in zip(PARAMETERS, sigmas, strict=True):
        e = found[name]
        if e.value is not None:
            factor = abs(e.value) if name == PARAMETERS[0] else 1.0
            found[name] = replace(e, sigma=float(sigma * factor))
    gained = np.diff(state.v_n[:, :2], axis=0)
    return Running(replace(method, estimates=found), sigmas, way,
                   float((gained**2).sum(axis=1) @ (1 / T)),
                   float(np.median((steps / T)[moving])) if moving.any() else 0.0)


def _of_cells(view, imu) -> float:
    """
    Return the relative error of the way that chords for arcs can make, cells being as wide.

    A turn by theta within a step shortens the chord of its middle by theta^2 / 12.
    """
    way = np.abs(np.diff(view.travel.at(imu.t)))
    return float(way @ (imu.turns()**2).sum(axis=1) / (12 * max(way.sum(), 1e-9)))
