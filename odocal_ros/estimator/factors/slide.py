# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Lower limits of sideslip and vertical motion, by the turns of the leg.

Sideslip is observable in turns: a leg with turns uses its own estimate. On a straight leg a
constant sideslip cannot be separated from the mounting yaw: the noise of an ordinary road is the
lower limit, even if the residuals of single seconds are smaller.
"""

import numpy as np

from odocal_ros.estimator.factors.interval_noise import TURNING_RATE
from odocal_ros.estimator.imu_steps import ImuSteps
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.start import rest_bias
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import SWAY

# m/sqrt(s), lower limit of sideslip if turns determine it. Tuned: the yaw sigma of simulated
# vehicles, which do not slide, then matches their errors (docs/decisions/0005)
TURN_SLIDE = 2e-4
# m/sqrt(s), lower limit of vertical motion that the unknowns do not describe: springs, tyres,
# road. Tuned: with a tenth, pitch in yards was 3 sigmas off (docs/decisions/0005)
HEAVE = 2e-3
# m/rad, by which the pitch of a body within a second lifts its axle beyond the model, as kerbs
# shorter than a wheelbase do: initial level and lower limit, judgement; each drive has its own
PITCHING, PITCHING_LEAST = 0.03, 1e-4
# m/sqrt(s), an ordinary road: physical, a body's sway, white at 10 Hz
ORDINARY_ROAD = SWAY / np.sqrt(10.0)
# rad, total turn: one crossroads does not determine sideslip, two do. Judgement
NO_TURN = np.pi / 2
SIDEWAYS = ('side', 'side_turn', 'up')


def turned(leg: SmootherLeg, imu: ImuSteps) -> float:
    """Return the total angle of turns faster than TURNING_RATE, without sign, rad."""
    t = imu.t[imu.key]
    T = np.diff(t)
    bias = rest_bias(leg, imu)
    turn = imu.over_intervals(imu.turn) - (0.0 if bias is None else bias) * T[:, None]
    up = imu.signals[:, 3:].sum(axis=0)
    angle = np.abs(turn @ up) / np.linalg.norm(up)
    path = np.abs(np.diff(leg.travel.at(t))) * leg.rough_scale
    return float(angle[(angle > TURNING_RATE * T) & (path > 0.2 * T)].sum())    # m/s: moving


def least_slide(angle: float) -> float:
    """Return the minimum sideways and vertical noise, m/sqrt(s), by the total turn angle, rad."""
    tested = np.clip((angle - NO_TURN) / NO_TURN, 0.0, 1.0)
    return float(ORDINARY_ROAD * (TURN_SLIDE / ORDINARY_ROAD)**tested)


def assumed(problem: Problem, levels: Levels) -> list[Reason]:
    """Return the reason that reports an assumed road noise, if it affects the result."""
    least = problem.least['side']
    if least < 2e-3**2 or all(      # m^2/s, smallest that is reported
            levels[name] > 1.01 * least for name in SIDEWAYS):
        return []
    return [Reason(
        Code.PARAMETER_NOT_DETERMINED, 'not observable on this drive: sideslip; turns faster than '
        f'{np.rad2deg(TURNING_RATE):.0f} deg/s add up to {np.rad2deg(problem.turned):.0f} deg, '
        f'less than the limit of {np.rad2deg(2 * NO_TURN):.0f} deg. '
        f'{1e3 * np.sqrt(least):.0f} mm/√s is assumed; the uncertainties of the mounting angles '
        'depend on it', 'Drive with left and right turns.')]
