# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Initial values of the fit: decimated epochs, a robust similarity, outliers among the fixes."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import State
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.settings.levels import NORMAL_MEDIAN, OUTLIER_SIGMAS, RAYLEIGH_MEDIAN


def thinned(leg: WheelLeg, rate: float = 20.0) -> WheelLeg:
    """
    Return a leg with no more epochs than a rate, Hz: of sums, nothing is lost.

    At 20 Hz a turn bends the way between two of them by a millimetre.
    """
    t = leg.left.t
    step = max(1, int((len(t) - 1) / max(t[-1] - t[0], 1e-9) / rate))
    pick = np.unique(np.append(np.arange(0, len(t), step), len(t) - 1))

    def few(track: Track) -> Track:
        return Track(track.t[pick], track.q_nb[pick], track.s[pick], track.P[pick])
    return replace(leg, left=few(leg.left), right=few(leg.right))


def first_state(leg: WheelLeg, inside: Bools, variance: Floats) -> tuple[State, Floats]:
    """Return a first state by the mean track against the fixes in the level, and residuals."""
    t = leg.t_fix[inside]
    P = ((leg.left.at(t) + leg.right.at(t) - leg.left.at(leg.start.t) - leg.right.at(leg.start.t))
         / 2)[:, :2, :2]
    arm = (leg.left.C_nb_at(t) - leg.left.C_nb_at(np.array(leg.start.t))) @ leg.lever_b
    y = (leg.fixes_n[inside] - arm)[:, :2].ravel()
    A = np.concatenate([P, np.tile(np.eye(2), (len(t), 1, 1))], -1).reshape(-1, 4)
    sigma = np.repeat(np.sqrt(variance[inside]), 2)
    weight = 1 / sigma
    for _ in range(8):      # Huber, scaled by the median: outliers do not pull
        x = np.linalg.lstsq(A * weight[:, None], y * weight, rcond=None)[0]
        off = np.abs(y - A @ x)
        # from 1.345 sigmas on the pull no longer grows: 95 % efficient with normal errors
        bound = 1.345 * (np.median(off) / NORMAL_MEDIAN)
        weight = np.sqrt(np.minimum(1.0, bound / np.maximum(off, 1e-9))) / sigma
    start = np.append(x[2:], leg.start.position_n[2])
    state = State(float(np.hypot(*x[:2])), 0.0, float(np.arctan2(x[1], x[0])), 0.0, start, 0.0,
                  0.0, np.zeros((1, 3)))
    return state, (y - A @ x).reshape(-1, 2)


def near_neighbours(residual: Floats, sigma: Floats, beside: int = 7) -> Bools:
    """
    Tell which fixes lie with those beside them.

    residual : (k, 2) fixes less a track, m, slow errors and all.   sigma : (k,) stated.
    beside : fixes each side.
    """
    span = 2 * beside + 1
    if len(residual) <= span:
        return np.ones(len(residual), bool)
    padded = np.pad(residual, ((beside, beside), (0, 0)), mode='reflect')
    windows = np.lib.stride_tricks.sliding_window_view(padded, span, axis=0)
    off = np.hypot(*(residual - np.median(windows, axis=-1)).T)
    usual = max(np.median(off / sigma) / RAYLEIGH_MEDIAN, 0.2)
    out: Bools = off <= OUTLIER_SIGMAS * usual * sigma
    return out
