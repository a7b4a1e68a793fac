# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Start of the running estimate from the previous one: keyframes that stay, the state extended.

New samples change the earlier states only a little, so few passes are enough.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.estimator.factors.factor import SPREAD
from odocal_ros.estimator.factors.motion import gravity_n
from odocal_ros.estimator.factors.odometer_filter import as_rolled
from odocal_ros.estimator.fit import WarmStart
from odocal_ros.estimator.imu_steps import ImuSteps
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.preintegrate import preintegrate
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.start import SPEED_WINDOW
from odocal_ros.estimator.state import State


def steps_of(view: SmootherLeg, spacing: float) -> ImuSteps:
    """
    Return the steps of a leg whose keyframes keep their times as it grows.

    They lie at multiples of ``spacing``; first and last row are keyframes too.
    """
    first = int(np.searchsorted(view.t_imu, view.t_begin))
    last = int(np.searchsorted(view.t_imu, view.t_stop, side='right')) - 1
    t = view.t_imu[first:last + 1]
    grid = np.arange(np.ceil(t[0] / spacing), t[-1] / spacing) * spacing
    k = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    k -= grid - t[k - 1] < t[k] - grid
    inside = (t[k] > t[0] + spacing / 2) & (t[k] < t[-1] - spacing / 2)
    key = np.unique(np.concatenate([[0], k[inside], [len(t) - 1]]))
    return ImuSteps.between(view, key + first)


def carried(last: WarmStart, problem: Problem) -> WarmStart | None:
    """
    Return the start from the last fit, extended to new keyframes.

    None if keyframes differ, or the constants in use: a sensor started to publish.
    """
    t, old = problem.imu.t[problem.imu.key], last.state.t
    rounding = 1e-6     # s
    at = np.clip(np.searchsorted(old, t - rounding), 0, len(old) - 1)
    same = np.abs(old[at] - t) < rounding
    n = len(t) if same.all() else int(np.argmin(same))
    # s at the end, in which rows may have arrived late
    if n < 2 or t[n - 1] < old[-1] - 3.0 or last.priors.in_use != problem.priors.in_use:
        return None
    at = at[:n]
    state = replace(last.state, **{
        name: value[at] for name, value in last.state.of_keyframes().items()})
    slipped = [last.spread[a:b].mean(axis=0) for a, b in zip(at[:-1], at[1:], strict=True)]
    spread = np.concatenate([slipped, np.ones((len(t) - n, SPREAD))])
    levels = problem.first_levels.but(**last.levels.values)
    return WarmStart(_reckoned(state, problem) if n < len(t) else state, levels, last.priors,
                     problem.priors, spread)


def _reckoned(state: State, problem: Problem) -> State:
    """Return a state extended by dead reckoning with gyro and odometer to the new keyframes."""
    imu, leg, n = problem.imu, problem.leg, len(state.t)
    key = imu.key[n - 1:]
    rows = replace(imu, key=key)
    K, c = len(key) - 1, state.constants
    on = {name: np.concatenate([value, np.repeat(value[-1:], K, axis=0)])
          for name, value in state.of_keyframes().items()}
    t = on['t'] = imu.t[imu.key]
    on['travel_error'][n:] = 0.0
    f = state.scale * state.forward

    travel = as_rolled(leg.travel, c)
    sums, _ = preintegrate(rows, on['gyro_bias'][n:], on['accel_bias'][n:], travel,
                           f, np.empty(0), c)
    for k in range(K):
        on['C_nb'][n + k] = on['C_nb'][n + k - 1] @ sums.R[k]
    C = on['C_nb']
    arm_b = state.C_bv @ (leg.odometer_arm - leg.imu_arm)
    steps = np.einsum('kij,kj->ki', C[n - 1:-1], sums.S @ f) - (C[n:] - C[n - 1:-1]) @ arm_b
    on['p_n'][n:] = on['p_n'][n - 1] + np.cumsum(steps, axis=0)
    speed = (travel(t[n:] + SPEED_WINDOW) - travel(t[n:] - SPEED_WINDOW)) / (2 * SPEED_WINDOW)
    on['v_n'][n:] = (C[n:] @ f) * speed[:, None]
    gained = np.einsum('kij,kj->ki', C[n - 1:-1], sums.dv) + sums.T[:, None] * gravity_n(
        on['p_n'][n:], leg.origin)
    for late in np.flatnonzero(t[n:] + SPEED_WINDOW > leg.travel.t[-1]):
        on['v_n'][n + late] = on['v_n'][n + late - 1] + gained[late]
    return State(**on, constants=c)
