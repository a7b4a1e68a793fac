# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Wheels of a simulated vehicle: their positions and scales, and the paths that they roll.

In: the true motion. Out: paths with growth and slip of the tyres, and speeds as a vehicle bus
publishes them.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.time_series import running_integral
from odocal_ros.settings.config import MECANUM, OMNI, SIDES, SKID
from odocal_ros.sim.motion import contact_speed, State, turn_rate
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.vehicle_distributions import G

AXLES = {1: ('rear',), 2: ('front', 'rear'), 3: ('front', 'middle', 'rear'),
         4: ('front', 'second', 'third', 'rear')}
# of skid steering: effective over geometric track width in a turn on the spot and straight on.
# Judgement: published centres of rotation are 1.3 to 2 times as far apart as the wheels
SPOT_RATIO, STRAIGHT_RATIO = 1.7, 1.4
LATERAL_RATIO = 0.95     # judgement: sideways motion over rolled path of mecanum wheels, by slip
ROLLING_RESISTANCE = 0.01    # physical: rolling resistance over load, of tyres on asphalt
AIR_DRAG = 1e-5              # judgement: air drag over load, per (m/s)^2


@dataclass(frozen=True, eq=False)
class SimWheel:
    """A wheel with an odometer."""

    name: str         # joint
    stream: str       # name of its random numbers
    arm: Floats       # (3,) m, contact point in base_link
    scale: float      # true scale factor
    steered: bool = False    # it is turned to its rolling direction (Ackermann)


def wheels_of(options: SimOptions) -> list[SimWheel]:
    """
    Return the wheels of resolved options, left before right of each axle from front to rear.

    An odd number has a single front wheel, the last one. ``options.scale`` converts the mean count
    of the wheels that do not steer to metres: it is the harmonic mean of their scales.
    """
    n, middle = options.wheel_count, np.asarray(options.odometer_lever_arm, dtype=float)
    if n == 1:
        return [SimWheel('wheel_joint', 'L', middle, options.scale)]
    half = np.array([0.0, options.track_width / 2, 0.0])
    if options.drive == OMNI:
        angle = 2 * np.pi * np.arange(n) / n      # counter-clockwise from the x axis
        arms = options.track_width / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        return [SimWheel(f'omni_{k}', f'omni_{k}', middle + arm, scale) for k, (arm, scale)
                in enumerate(zip(arms, _scales(options, np.ones(n, bool)), strict=True), 1)]
    if n == len(SIDES):
        ratio = 1 + options.wheel_difference        # right over left
        left = options.scale * (1 + 1 / ratio) / 2
        return [SimWheel(f'{side}_wheel_joint', stream, middle + arm, scale)
                for side, stream, arm, scale in zip(SIDES, 'LR', (half, -half),
                                                    (left, left * ratio), strict=True)]
    positions = [(f'{axle}_{side}', axle, arm) for axle in AXLES[n // 2]
                 for side, arm in zip(SIDES, (half, -half), strict=True)]
    positions += [('front', 'front', 0 * half)] * (n % 2)
    front = np.array([options.wheelbase, 0.0, 0.0])
    steered = np.array([axle == 'front' and options.front_steers for _, axle, _ in positions])
    return [SimWheel(name, name, middle + arm + front * (axle == 'front'), scale, steers)
            for (name, axle, arm), scale, steers in zip(
                positions, _scales(options, ~steered), steered.tolist(), strict=True)]


def _scales(options: SimOptions, in_mean: Bools) -> list[float]:
    """Return random scales of n wheels; in_mean : (n,) True for wheels of the mean count."""
    n = len(in_mean)
    scales = 1 + options.wheel_difference * make_rng(options.seed, 'wheels').standard_normal(n)
    scales *= options.scale * np.mean(1 / scales[in_mean])
    return [float(scale) for scale in scales]


def steered_path(state: State, arm: Floats) -> Floats:
    """Return the path length of a steered wheel minus that of a fixed one at its side: (n,)."""
    x, y, z = arm
    along = contact_speed(state, (0.0, y, z))
    additional = np.copysign(np.hypot(along, x * turn_rate(state)) - np.abs(along), along)
    return running_integral(state.t, additional)


def effective_width(options: SimOptions, radius: float = 0.0) -> float:
    """Return the effective track width, m, at a turn radius, m."""
    if options.drive == MECANUM:
        return 2 * options.track_width      # a robot as long as wide
    if options.drive == SKID:
        return options.track_width * float(_widening(np.array(radius), options.track_width))
    return options.track_width


def _widening(radius: Floats, width: float) -> Floats:
    """Return the ratio of effective to geometric track width of skid steering, by turn radii."""
    return SPOT_RATIO + (STRAIGHT_RATIO - SPOT_RATIO) * radius / (radius + width)


def robot_path(state: State, options: SimOptions, wheel: SimWheel) -> Floats:
    """Return the path rolled by a wheel of skid steering, mecanum or omni, m: (n,)."""
    x, y, _ = wheel.arm - np.asarray(options.odometer_lever_arm)      # from the middle
    if options.drive == OMNI:       # it rolls clockwise about the middle, seen from above
        radius = np.hypot(x, y)
        lateral = running_integral(state.t, state.sway[:, 0])
        return np.asarray((y * state.travel - x * lateral) / radius - radius * state.turn_angle)
    side = -1.0 if y > 0 else 1.0       # left, right
    if options.drive == MECANUM:
        lateral = running_integral(state.t, state.sway[:, 0]) / LATERAL_RATIO
        rollers = side if wheel.name.startswith('front') else -side
        return (state.travel + rollers * lateral
                + side * effective_width(options) / 2 * state.turn_angle)
    rate = np.maximum(np.abs(state.yaw_rate), 1e-9)
    half = options.track_width * _widening(np.abs(state.speed) / rate, options.track_width) / 2
    turns = np.diff(state.turn_angle, prepend=state.turn_angle[:1])
    by_turn: Floats = np.cumsum((half + np.append(half[:1], half[:-1])) / 2 * turns)
    return state.travel + side * by_turn


def tyre_growth(state: State, real: RealEffects) -> Floats | float:
    """Return the relative growth of the rolling radius from a cold, slow tyre: (n,), or 0.0."""
    growth: Floats | float = 0.0
    if real.speed_law:
        growth = growth + real.speed_law * (state.speed / 36.0)**2    # as defined in RealEffects
    if real.warming:
        steps = np.diff(state.t, prepend=state.t[:1]) * (np.abs(state.speed) > 1e-9)
        growth = growth - real.warming * np.expm1(-np.cumsum(steps) / real.warming_time)
    return growth


def slip_share(state: State, real: RealEffects) -> Floats:
    """Return the slip per metre of path under traction and braking: (n,)."""
    forward = np.where(state.speed < 0, -1.0, 1.0)
    # force over load; a slope adds to it
    force = (forward * (state.acceleration / G + state.slope) + ROLLING_RESISTANCE
             + AIR_DRAG * state.speed**2)
    # half of the load is on the driven axle; all wheels brake
    pull = 2 * np.maximum(force, 0.0) if real.driven else np.zeros_like(force)
    return np.asarray(real.tyre_slip * (pull + np.minimum(force, 0.0)))


def tyre_slip(state: State, real: RealEffects) -> Floats:
    """Return the accumulated tyre slip at each time, m: (n,)."""
    return np.cumsum(slip_share(state, real) * np.diff(state.travel, prepend=state.travel[:1]))


def leg_factor(state: State, real: RealEffects, start_slip: Floats) -> float:
    """Return the true path over the path counted by a cold wheel; start_slip : (n,) m, so far."""
    if not (real.speed_law or real.warming or real.tyre_slip or start_slip.any()):
        return 1.0
    path_length = np.diff(state.travel)
    slip = np.diff(start_slip + tyre_slip(state, real) if real.tyre_slip else start_slip)
    growth = tyre_growth(state, real) + np.zeros_like(state.t)
    counted = (path_length + slip) / (1 + (growth[1:] + growth[:-1]) / 2)
    return float(np.abs(path_length).sum() / np.abs(counted).sum())


def low_pass_speed(speed: Floats, t: Floats, tau: float) -> Floats:
    """Return speeds after a first-order filter with a time constant tau, s; 0: none."""
    if not tau:
        return speed
    out, share = speed.tolist(), -np.expm1(-np.diff(t) / tau)
    for k, a in enumerate(share.tolist(), 1):
        out[k] = out[k - 1] + a * (out[k] - out[k - 1])
    return np.array(out)


def published_speed(speed: Floats, real: RealEffects) -> Floats:
    """Return the published speeds: in steps, 0 below the dead band, or held."""
    if real.speed_step:
        steps = np.abs(speed) / real.speed_step
        steps = np.floor(steps) if real.speed_rounding == 'floor' else np.floor(steps + 0.5)
        speed = np.sign(speed) * steps * real.speed_step
    if real.dead_band:
        speed = np.where(np.abs(speed) < real.dead_band, 0.0, speed)
    return hold_speed(speed, real.speed_hold) if real.speed_hold else speed


def hold_speed(speed: Floats, step: float) -> Floats:
    """Return speeds, each held until the next is 0 or differs by a step."""
    out = speed.tolist()
    for k, value in enumerate(out[1:], 1):
        if value and abs(value - out[k - 1]) < step:
            out[k] = out[k - 1]
    return np.array(out)
