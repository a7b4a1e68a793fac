# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The two equations of the wheels, docs/method.md (W3), (W4), linearised, on bins of time.

    fix(t)  = p0 + sum to t - D of C (K_L dP_L + K_R dP_R) / 2 d + lever arm + lag + fix error
    0       = K_R s_R - K_L s_L - w psi - d0 + count error

d is the forward axis in b, D the latency of the fixes, w the track width, psi the turn of the
vehicle by gyro. What the gyro errs by, phi(t) (true attitude = exp(phi) computed), is common to
both: a random process with its values at nodes, linear in between, and -g / (1 + g) times the turn
so far of a gyro that reads (1 + g) times the rate. D and g have priors and are estimated
with all else: their squares matter (50 ms in a bend: 5 ppm of 2 km; 1 % of a full turn: 2000 ppm).
So is the lag of a receiver that smooths, beyond a delay: a town of RTK fixes lagging by 1 s was
500 ppm off at 5 ppm stated without it.

Fixes and turns are averaged over the bins between the nodes: the equations are linear in what is
averaged, so that nothing is approximated but the little that a bin knows beyond its mean.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheels.leg import C_bv, WheelLeg
from odocal_ros.calib.wheels.way import Way
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.receiver_filter import smoothing
from odocal_ros.nav.rotations import exp_so3, matrix_from_quat

Array = NDArray[np.float64]
PARAMETERS = ('scale', 'log_ratio', 'heading', 'east', 'north', 'width', 'turn_offset', 'latency',
              'gyro_scale', 'fix_lag_square')
SCALE, RATIO, HEADING, EAST, NORTH, WIDTH, OFFSET, LATENCY, GYRO, FIX_LAG2 = range(
    len(PARAMETERS))
NUISANCES = [LATENCY, GYRO, FIX_LAG2]    # with priors, estimated, and no result
# s each side that a velocity is taken over: judgement, a few rows of an odometer, little of a turn
VELOCITY_WINDOW = 0.25


@dataclass(frozen=True, eq=False)
class State:
    """
    Where the equations are linearised.

    phi : (nodes, 3) rad, n.   latency : s by which stamps of the fixes are late.
    gyro_scale : relative error of the gyro's scale, positive where it reads too much.
    fix_lag_square : s^2, of the time constant by which the receiver smooths.
    """

    scale: float
    log_ratio: float
    heading: float
    pitch: float
    start_n: Array       # (3,) m, antenna at the start mark
    width: float
    offset: float
    phi: Array
    latency: float = 0.0
    gyro_scale: float = 0.0
    fix_lag_square: float = 0.0


@dataclass(frozen=True, eq=False)
class Bins:
    """Bins of time: edges (N + 1,) s; fixes kept (k,), bin of each, share of its bin's mean."""

    edges: Array
    fix: NDArray[np.int64]
    of_fix: NDArray[np.int64]
    share: Array

    def mean(self, x: Floats) -> Floats:
        """Return the bins' weighted means of values at the fixes: (k, ...) to (N, ...)."""
        out = np.zeros((len(self.edges) - 1, *x.shape[1:]))
        np.add.at(out, self.of_fix, x * self.share.reshape(-1, *[1] * (x.ndim - 1)))
        return out

    @property
    def filled(self) -> Bools:
        """Tell which bins hold fixes."""
        return np.bincount(self.of_fix, minlength=len(self.edges) - 1) > 0


@dataclass(frozen=True, eq=False)
class Equations:
    """
    The linearised equations, by bin (N) and node (N + 1).

    residual : (N, 3) fix less model, m; detail : (k, 3) of each fix.
    by : (N, 3, 7) derivative of the model's position by ln scale, ln ratio, heading, pitch,
    latency, gyro scale, fix_lag_square.     by_phi : (N, N + 1, 3) way that turns with each node.
    turn : (N,) residual of the turn equation, m.
    turn_by : (N, 5) of its model by ln scale, ln ratio, width, d0, gyro scale.
    velocity : (N, 3) m/s at the fixes.      late : (N, 3) what an odometer late by 1 s does, m.
    lever : (N, 3, 3) turn of the antenna's arm since the start.
    forward : (N, 3) forward axis.           moving : (N,) s in motion in each bin.
    rests : (N, r) share of each bin that is spent in each standstill.
    counts : (N,) mean counts of a wheel in each bin.
    phi_axes : (N + 1, 3, 3) attitude summed over time to each node: s, n by axis of b.
    yaw : (N + 1,) turn by gyro.    by_gyro_scale : (N + 1,) drift of heading by the gyro's scale.
    way : (N, 3) of each bin, m.
    """

    residual: Array
    detail: Array
    by: Array
    by_phi: Array
    turn: Array
    turn_by: Array
    velocity: Array
    late: Array
    lever: Array
    forward: Array
    moving: Array
    rests: Array
    counts: Array
    phi_axes: Array
    yaw: Array
    by_gyro_scale: Array
    way: Array

    @property
    def length(self) -> Floats:
        """Return the length of the way in each bin, (N,) m."""
        out: Floats = np.linalg.norm(self.way, axis=1)
        return out


def make_bins(t_fix: Floats, keep: Bools, variance: Floats, t_start: float, t_stop: float,
              n: int) -> Bins:
    """Return n bins of equal length over a range, s, with the fixes of a mask in them."""
    edges = np.linspace(t_start, t_stop, n + 1)
    fix = np.flatnonzero(keep & (t_fix >= t_start) & (t_fix <= t_stop))
    of_fix = np.clip(np.searchsorted(edges, t_fix[fix], side='right') - 1, 0, n - 1)
    weight = 1 / variance[fix]
    return Bins(edges, fix, of_fix, weight / np.bincount(of_fix, weight, n)[of_fix])


def equations(leg: WheelLeg, bins: Bins, state: State, since: float) -> Equations:
    """
    Return the equations linearised about a state.

    since : s, from when on the gyro's errors count: where the heading holds.
    """
    way = Way(leg, bins, state, since)
    t = leg.t_fix[bins.fix] - state.latency
    arm = _arm(leg, state, way, t)
    smoothed, by_lag = _smoothed(leg, state, way, t)
    detail = leg.fixes_n[bins.fix] - (state.start_n + way.at('v', t) + arm @ leg.lever_b
                                      + smoothed)
    before, after = (np.clip(t + x, *way.t[[0, -1]]) for x in (-VELOCITY_WINDOW, VELOCITY_WINDOW))
    velocity = (way.at('v', after) - way.at('v', before)) / np.maximum(
        after - before, 1e-6)[:, None]
    by = np.stack([*(way.at(name, t) for name in ('v', 'ratio', 'heading', 'pitch')), -velocity,
                   way.at('gyro_scale', t), by_lag], -1)
    turn, turn_by, yaw = way.turn(state)
    rests, moving, counts = way.rests()
    step_n = np.diff(way.at('v', bins.edges), axis=0)
    return Equations(
        bins.mean(detail), detail, bins.mean(by), way.by_phi(t), turn, turn_by,
        bins.mean(velocity), bins.mean(way.at('late', t) - velocity), bins.mean(arm),
        way.forward(), moving, rests, counts, _axes(leg, bins.edges, since), yaw,
        np.interp(bins.edges, way.t, way.by_gyro_scale), step_n)


def _arm(leg: WheelLeg, state: State, way: Way, t: Floats) -> Floats:
    """Return the attitude of v less that at the start mark, (k, 3, 3)."""
    C = leg.left.C_nb_at(t) - leg.left.C_nb_at(np.array(leg.start.t))
    return exp_so3(way.phi(t)) @ C @ C_bv(state.heading, state.pitch)


def _smoothed(leg: WheelLeg, state: State, way: Way, t: Floats) -> tuple[Floats, Floats]:
    """Return what smoothing adds to places at times, and its derivative: (k, 3) m each."""
    grid = np.arange(way.t[0], way.t[-1], 2 * VELOCITY_WINDOW)
    place = way.at('v', grid) + _arm(leg, state, way, grid) @ leg.lever_b
    return smoothing(grid, place, np.gradient(place, grid, axis=0), t, state.fix_lag_square)


def _axes(leg: WheelLeg, edges: Floats, since: float) -> Floats:
    """Return the attitude summed over time from ``since`` to each node, (N + 1, 3, 3) s."""
    track = leg.left
    C = matrix_from_quat(track.q_nb)
    total = np.zeros_like(C)
    np.cumsum((C[:-1] + C[1:]) * (np.diff(track.t) / 2)[:, None, None], axis=0, out=total[1:])
    flat = total.reshape(-1, 9)
    here = np.stack([np.interp(edges, track.t, c) for c in flat.T], -1)
    then = np.array([np.interp(since, track.t, c) for c in flat.T])
    out: Floats = (here - then).reshape(-1, 3, 3)
    return out
