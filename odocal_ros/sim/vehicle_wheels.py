# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The wheels of a simulated vehicle: where they roll, their scale factors, which ones steer."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.settings.config import SIDES
from odocal_ros.sim.motion import contact_speed, State, turn_rate
from odocal_ros.sim.noise import stream
from odocal_ros.sim.options import SimOptions

AXLES = {1: ('rear',), 2: ('front', 'rear'), 3: ('front', 'middle', 'rear'),
         4: ('front', 'second', 'third', 'rear')}


@dataclass(frozen=True, eq=False)
class SimWheel:
    """
    A wheel.

    name : joint.   draws : name of its random numbers.   arm : (3,) m, contact point in base_link.
    scale : true scale factor.   steered : it points where it rolls (Ackermann).
    """

    name: str
    draws: str
    arm: Floats
    scale: float
    steered: bool = False


def wheels_of(options: SimOptions) -> list[SimWheel]:
    """
    Return the wheels of resolved options, left before right of each axle from front to rear.

    An odd number has a single front wheel, the last one. ``options.scale`` turns the mean of the
    wheels that do not steer into metres: it is the harmonic mean of theirs.
    """
    n, middle = options.wheel_count, np.asarray(options.odometer_lever_arm, dtype=float)
    if n == 1:
        return [SimWheel('wheel_joint', 'L', middle, options.scale)]
    half = np.array([0.0, options.track_width / 2, 0.0])
    if n == len(SIDES):
        ratio = 1 + options.wheel_difference        # right over left
        left = options.scale * (1 + 1 / ratio) / 2
        return [SimWheel(f'{side}_wheel_joint', draws, middle + arm, scale)
                for side, draws, arm, scale in zip(SIDES, 'LR', (half, -half),
                                                   (left, left * ratio), strict=True)]
    places = [(f'{axle}_{side}', axle, arm) for axle in AXLES[n // 2]
              for side, arm in zip(SIDES, (half, -half), strict=True)]
    places += [('front', 'front', 0 * half)] * (n % 2)
    front = np.array([options.wheelbase, 0.0, 0.0])
    steered = np.array([axle == 'front' and options.front_steers for _, axle, _ in places])
    scales = 1 + options.wheel_difference * stream(options.seed, 'wheels').standard_normal(n)
    scales *= options.scale * np.mean(1 / scales[~steered])
    return [SimWheel(name, name, middle + arm + front * (axle == 'front'), float(scale), steers)
            for (name, axle, arm), scale, steers in zip(places, scales, steered.tolist(),
                                                        strict=True)]


def steered_path(state: State, arm: Floats) -> Floats:
    """Return the metres that a steered wheel rolls beyond a fixed one at its side: (n,)."""
    x, y, z = arm
    along = contact_speed(state, (0.0, y, z))
    more = np.copysign(np.hypot(along, x * turn_rate(state)) - np.abs(along), along)
    steps = np.diff(state.t) * (more[1:] + more[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])
