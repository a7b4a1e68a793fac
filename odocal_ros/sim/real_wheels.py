# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What real wheels and their senders add: tyres that grow, slip under force, coarse speeds."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.sim.motion import State
from odocal_ros.sim.real import Real
from odocal_ros.sim.zoo import G

REST = 0.01          # physical: rolling resistance over load, of tyres on asphalt
AIR = 1e-5           # judgement: air drag over load, per (m/s)^2


def growth(state: State, real: Real) -> Floats | float:
    """Return by how much the rolling radius exceeds that of a cold, slow tyre: (n,), or 0.0."""
    grown: Floats | float = 0.0
    if real.speed_law:
        grown = grown + real.speed_law * (state.speed / 36.0)**2    # as stated
    if real.warming:
        steps = np.diff(state.t, prepend=state.t[:1]) * (np.abs(state.speed) > 1e-9)
        grown = grown - real.warming * np.expm1(-np.cumsum(steps) / real.warming_time)
    return grown


def slip_share(state: State, real: Real) -> Floats:
    """Return the metres spun beyond each metre of ground as the tyres pull or brake: (n,)."""
    forward = np.where(state.speed < 0, -1.0, 1.0)
    # over load; up a slope they pull too
    force = forward * (state.acceleration / G + state.slope) + REST + AIR * state.speed**2
    # half of the load is on the driven axle; all wheels brake
    pull = 2 * np.maximum(force, 0.0) if real.driven else np.zeros_like(force)
    share: Floats = real.tyre_slip * (pull + np.minimum(force, 0.0))
    return share


def tyre_slip(state: State, real: Real) -> Floats:
    """Return the metres spun beyond the ground by then: (n,)."""
    path_length = np.diff(state.travel, prepend=state.travel[:1])
    return np.cumsum(slip_share(state, real) * path_length)


def leg_factor(state: State, real: Real) -> float:
    """
    Return true metres rolled over those of a wheel that neither grew nor slipped.

    state : between the marks of the leg. The mean is by travel in both directions.
    """
    if not (real.speed_law or real.warming or real.tyre_slip):
        return 1.0
    path_length = np.diff(state.travel)
    spun = np.diff(tyre_slip(state, real)) if real.tyre_slip else 0.0
    grown = growth(state, real) + np.zeros_like(state.t)
    counted = (path_length + spun) / (1 + (grown[1:] + grown[:-1]) / 2)
    return float(np.abs(path_length).sum() / np.abs(counted).sum())


def low_passed(speed: Floats, t: Floats, time: float) -> Floats:
    """Return speeds behind a first-order filter of a time constant, s; 0: none."""
    if not time:
        return speed
    out, share = speed.tolist(), -np.expm1(-np.diff(t) / time)
    for k, a in enumerate(share.tolist(), 1):
        out[k] = out[k - 1] + a * (out[k] - out[k - 1])
    return np.array(out)


def coarse(speed: Floats, real: Real) -> Floats:
    """Return the published speeds: in steps, 0 below the dead band, or held."""
    if real.speed_step:
        steps = np.abs(speed) / real.speed_step
        steps = np.floor(steps) if real.speed_rounding == 'floor' else np.floor(steps + 0.5)
        speed = np.sign(speed) * steps * real.speed_step
    if real.dead_band:
        speed = np.where(np.abs(speed) < real.dead_band, 0.0, speed)
    return held(speed, real.speed_hold) if real.speed_hold else speed


def held(speed: Floats, step: float) -> Floats:
    """Return speeds that repeat until one is 0 or differs by a step."""
    out = speed.tolist()
    for k, now in enumerate(out[1:], 1):
        if now and abs(now - out[k - 1]) < step:
            out[k] = out[k - 1]
    return np.array(out)
