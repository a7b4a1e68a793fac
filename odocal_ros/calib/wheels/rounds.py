# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Gauss-Newton iterations of the wheels: linearised, variance components judged, solved."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.wheels.height import Height, solve_height
from odocal_ros.calib.wheels.judge_noise import judge_fixes, judge_turns, TurnNoise, white_share
from odocal_ros.calib.wheels.least_squares import design, Drift, Fit, least_squares
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import (
    Bins,
    Equations,
    equations,
    FIX_LAG2,
    GYRO,
    HEADING,
    LATENCY,
    OFFSET,
    RATIO,
    SCALE,
    State,
    WIDTH,
)
from odocal_ros.calib.wheels.noise import (
    drift_covariance,
    known_parts,
    Part,
    phi_loading,
    quantisation,
    tilted,
    unknown_width,
    walk_root,
)
from odocal_ros.calib.wheels.priors import WheelPriors
from odocal_ros.calib.wheels.solution import Solution
from odocal_ros.calib.wheels.track_width import TRACK_WIDTH
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import OUTLIER_SIGMAS


class Rounds:
    """Gauss-Newton iterations over one leg, five at most."""

    def __init__(self, leg: WheelLeg, config: Config, bins: Bins, turn_rate: bool,
                 width: float) -> None:
        self.leg, self.config, self.turn_rate = leg, config, turn_rate
        self.bins, self.width = bins, width
        self.priors = WheelPriors(width, turn_rate, config.gnss.time_sigma,
                               leg.alignment.gyro_scale_sigma)
        self.since = leg.start.t if leg.alignment.heading_source == 'fixed' else leg.alignment.t
        n = len(bins.edges) - 1
        self.bad = np.zeros(n, bool)
        self.turns, self.width_observable, self.rounds = TurnNoise(), False, 0

    def run(self, state: State, fixes: int) -> Solution:
        """Return the solution from a first state."""
        again, dropped, small = False, 0, 0.01      # sigmas: of no step that matters
        for k in range(5):
            eq = equations(self.leg, self.bins, state, self.since)
            height = solve_height(self.leg, eq, self.bins, state, self.since)
            solution, step = self._round(eq, state, height, judge=k == 1 or again)
            state, again = solution.state, self.bad.sum() > dropped
            dropped = self.bad.sum()
            if k > 1 and not again and np.all(np.abs(step) < small):
                break
        return replace(solution, dropped=fixes - solution.kept,
                       settled=bool(np.all(np.abs(step) < 10 * small)))

    def _round(self, eq: Equations, state: State, height: Height,
               judge: bool) -> tuple[Solution, Floats]:
        leg, n = self.leg, len(eq.turn)
        L = phi_loading(eq, state.width)
        r = np.concatenate([eq.residual[:, 0], eq.residual[:, 1], eq.turn]) + L @ state.phi[:, 2]
        X = design(eq)
        self._judge_turns(eq, state, r, X, judge)
        parts = known_parts(leg, eq, self.bins, state, self.since, self.turns, self.config)
        parts.append(Part('pitch', np.concatenate(
            [eq.by[:, 0, 3], eq.by[:, 1, 3], 0 * eq.turn])[:, None] * height.pitch_sigma))
        parts.append(tilted(eq, state, height.tilt_variance))
        if not (self.width or self.width_observable):
            parts.append(unknown_width(eq, self._drift(eq)))
        known: Floats = sum((p.whole() for p in parts), np.zeros(()))
        if judge or self.rounds == 0:
            self._judge_fixes(eq, state, r, X, known, judge)
        fix = np.zeros((3 * n, 3 * n))
        fix[:2 * n, :2 * n] = self.noise.covariance
        parts.append(Part('fix_noise', covariance=fix))
        V = known + fix
        fit = self._fit(V, r, X, self._used(n), state, L, eq)
        if judge and self._drop_bins(fit, n):
            fit = self._fit(V, r, X, self._used(n), state, L, eq)
        # else the gyro's own drift would pass for turns, and the width for nothing
        self.width_observable = self._turns_observable(eq, V, r, X, state, L)
        widen = float(fit.step[WIDTH]) if self.width_observable else 0.0
        self.rounds += 1
        new = _stepped(state, fit, height, widen)
        step = fit.step / np.sqrt(np.diag(np.linalg.inv(fit.normal)))
        kept = int((~self.bad)[self.bins.of_fix].sum())
        return Solution(new, self.bins, eq, fit, fix[:, fit.use] @ fit.left, X,
                        self._steps(state)[0], tuple(parts), height, self.noise, self.turns,
                        kept, 0, self._bias(fit, L, eq), self.width_observable, False), \
            step[[SCALE, RATIO, HEADING]]

    def _turns_observable(self, eq: Equations, V: Floats, r: Floats, X: Floats, state: State,
                    L: Floats) -> bool:
        """Tell whether the track width is observable by turns: docs/method.md (W17)."""
        if not self.turn_rate:
            return False
        way = np.append(0.0, np.cumsum(eq.length))
        away = eq.yaw - np.polyval(np.polyfit(way, eq.yaw, 1), way)     # a ratio makes a line
        turned = np.sqrt((away**2).mean())
        far = turned / 10       # rad rms: judgement
        if far > np.sqrt(np.diag(self._drift(eq)).mean()):
            return True
        if self.rounds == 0 or turned < 0.05:       # rad rms: lanes changed, no turn
            return False
        level = self._used(len(eq.turn))        # the fixes alone may hold the drift
        level[2 * len(eq.turn):] = False
        drift = self._fit(V, r, X, level, state, L, eq).phi_sigma
        return bool(far > np.sqrt((drift**2).mean()))

    def _drift(self, eq: Equations) -> Floats:
        return drift_covariance(self.leg.alignment, self.bins, eq, self.since)

    def _used(self, n: int) -> Bools:
        level = self.bins.filled & ~self.bad
        return np.concatenate([level, level, np.full(n, self.turn_rate)])

    def _fit(self, V: Floats, r: Floats, X: Floats, use: Bools, state: State, L: Floats,
             eq: Equations) -> Fit:
        drift = Drift(L, self._drift(eq), eq.by_gyro_scale)
        return least_squares(V, r, X, drift, use, *self._steps(state))

    def _steps(self, state: State) -> tuple[Floats, Floats]:
        return self.priors.steps(self.leg, state, self.width_observable, self.rounds)

    def _bias(self, fit: Fit, L: Floats, eq: Equations) -> tuple[float, float]:
        """Return the gyro's bias about the vertical beyond that of the alignment, and sigma."""
        variance = self.leg.alignment.gyro_bias_sigma**2
        up = eq.phi_axes[:, 2]
        toward = up[-1] / max(np.linalg.norm(up[-1]), 1e-9)
        c = L[fit.use] @ (-up * variance) @ toward      # with what is observed
        left = toward**2 @ variance - c @ fit.P @ c
        return float(c @ fit.left), float(np.sqrt(max(left, 0.0)))

    def _drop_bins(self, fit: Fit, n: int) -> bool:
        """Reject bins by their normalised residuals, (W14); tell whether there are new ones."""
        z = np.zeros(3 * n)
        z[fit.use] = fit.left / np.sqrt(np.maximum(np.diag(fit.P), 1e-12))
        far = (np.hypot(z[:n], z[n:2 * n]) > OUTLIER_SIGMAS) & ~self.bad
        if not far.any() or (self.bad | far).mean() > 0.3:
            return False
        self.bad |= far
        return True

    def _judge_turns(self, eq: Equations, state: State, r: Floats, X: Floats, judge: bool) -> None:
        if not ((judge or self.rounds == 0) and self.turn_rate):
            return      # at first too: else the drift would take the slip upon itself
        n = len(eq.turn)
        turn = slice(2 * n, 3 * n)
        known = sum(p.whole()[turn, turn] for p in known_parts(
            self.leg, eq, self.bins, state, self.since, TurnNoise(counts=0.0), self.config))
        walk = walk_root(eq.moving)
        known = known + self.priors.nuisances(X[turn], state)
        columns = X[turn][:, [RATIO, WIDTH, OFFSET]]
        if self.width:      # given, and so no free column: its prior is part of what is known
            taped = TRACK_WIDTH.taped_share * self.width
            known = known + np.outer(columns[:, 1], columns[:, 1]) * taped**2
            columns = columns[:, [0, 2]]
        rounding = [quantisation(self.leg, eq, self.bins, state, level)[turn, turn]
                    for level in (0.0, 1.0)]
        self.turns = judge_turns(r[turn], columns, known, rounding[1] - rounding[0],
                                 2 * walk @ walk.T)

    def _judge_fixes(self, eq: Equations, state: State, r: Floats, X: Floats, known: Floats,
                     judge: bool) -> None:
        leg, bins, n = self.leg, self.bins, len(eq.turn)
        level = slice(0, 2 * n)
        k = np.array([SCALE, HEADING, 3, 4])
        white = white_share(leg.t_fix, eq.detail[:, :2], leg.covariance_n, bins)
        good = self._used(n)[level]
        known = known[level, level] + self.priors.nuisances(X[level], state)
        known += np.diag(np.where(good, 0.0, 1e12))     # dropped bins say nothing
        self.noise = judge_fixes(
            r[level], X[level][:, k], known, bins, leg.t_fix, leg.covariance_n, white,
            self.config.gnss.correlation_time if judge else 0)


def _stepped(state: State, fit: Fit, height: Height, widen: float) -> State:
    """Return the state after a step."""
    step = fit.step
    return replace(
        state, scale=state.scale * float(np.exp(np.clip(step[SCALE], -0.5, 0.5))),
        log_ratio=state.log_ratio + float(np.clip(step[RATIO], -0.5, 0.5)),
        heading=state.heading + float(step[HEADING]),
        width=max(state.width + widen, TRACK_WIDTH.least),
        offset=state.offset + float(step[OFFSET]), pitch=height.pitch,
        start_n=np.append(state.start_n[:2] + step[3:5], height.start),
        phi=np.column_stack([height.phi, fit.phi]), latency=state.latency + float(step[LATENCY]),
        gyro_scale=state.gyro_scale + float(np.clip(step[GYRO], -0.3, 0.3)),
        fix_lag_square=state.fix_lag_square + float(step[FIX_LAG2]))
