# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wheels of robots that slide in turns or move sideways: how far each rolls."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.settings.config import MECANUM, SIDES, SKID
from odocal_ros.sim.motion import State
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.vehicle_wheels import SimWheel

# of skid steering: effective over geometric track width in a turn on the spot and straight on.
# Judgement: published centres of rotation are 1.3 to 2 times as far apart as the wheels
SPOT, STRAIGHT = 1.7, 1.4
SIDEWAYS = 0.95     # judgement: motion over rolling of mecanum wheels sideways: rollers slip


def effective_width(options: SimOptions, radius: float = 0.0) -> float:
    """Return the effective track width, m, at a turn radius, m."""
    if options.drive == MECANUM:
        return 2 * options.track_width      # a robot as long as wide
    if options.drive == SKID:
        return options.track_width * float(_stretch(np.array(radius), options.track_width))
    return options.track_width


def _stretch(radius: Floats, width: float) -> Floats:
    out: Floats = SPOT + (STRAIGHT - SPOT) * radius / (radius + width)
    return out


def robot_path(state: State, options: SimOptions, wheel: SimWheel) -> Floats:
    """Return the metres that a wheel of skid steering or a mecanum wheel has rolled: (n,)."""
    side = -1.0 if wheel.name.split('_joint')[0].removesuffix('_wheel').endswith(SIDES[0]) else 1.0
    if options.drive == MECANUM:
        steps = np.diff(state.t) * (state.sway[1:, 0] + state.sway[:-1, 0]) / 2
        lateral = np.append(0.0, np.cumsum(steps)) / SIDEWAYS
        rollers = side if wheel.name.startswith('front') else -side
        return (state.travel + rollers * lateral
                + side * effective_width(options) / 2 * state.turned)
    rate = np.maximum(np.abs(state.yaw_rate), 1e-9)
    half = options.track_width * _stretch(np.abs(state.speed) / rate, options.track_width) / 2
    turns = np.diff(state.turned, prepend=state.turned[:1])
    by_turn: Floats = np.cumsum((half + np.append(half[:1], half[:-1])) / 2 * turns)
    return state.travel + side * by_turn
