# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The sprung body: accelerations cause pitch and roll, which move the sensors on it.

Roll and pitch are second-order systems, each about the rear axle's centre. Lateral forces of the
rear tyres cause sideslip: the axle's centre moves at an angle to its wheels.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.sim.motion import inertial_v, Motion, State
from odocal_ros.sim.profile import hermite, Hills, Profile
from odocal_ros.sim.real import Real
from odocal_ros.sim.zoo import G

# physical: natural frequency of a car's body on its springs, damped by shock absorbers
FREQUENCY = 2 * np.pi * 1.3   # rad/s
DAMPING = 0.3
STILL = 1e-9          # m/s, judgement: rounding
KNEELING_TIME = 2.0   # s, judgement: of the kneeling or rising of a bus


def tilts(speed: Profile, yaw_rate: Profile, real: Real, hills: Hills | None = None,
          lean: Profile | None = None) -> tuple[Profile, Profile]:
    """
    Return roll and pitch of the body relative to the vehicle by time, rad, fixed-axis angles.

    lean : of the road, included in the roll. The component of gravity along a slope or a lean acts
    like an acceleration. Both axles are on the road: the body is parallel to the chord of the
    wheelbase, and the rear axle moves along the road below it.
    """
    hills, wheelbase = hills or Hills(), real.wheelbase
    # s; the error of a cubic is then (w h)^4 / 384 = 2e-6; a kerb is passed within 0.2 s
    step = 0.005 if hills.kerbs else 0.02
    t = np.round(np.arange(0.0, speed.end + step, step), 9)
    v, s = speed(t), speed.integral()(t)
    # slopes at the rear axle and of the chord of the wheelbase, and derivatives by path length
    slope, slope_by_path, _ = hills(s)
    chord, chord_by_path = hills.chord(s, wheelbase) if wheelbase else (slope, slope_by_path)
    forward = speed.derivative().mean(t) + G * slope     # m/s^2
    # nose up is a negative pitch; in a turn to the left the left side goes up
    roll, roll_rate = sprung_response(real.body_roll * side_force(speed, yaw_rate, lean, t)
                                      + real.kneeling * kneeling_degree(speed, t), step)
    pitch, pitch_rate = sprung_response(-real.squat * forward, step)
    if lean:
        roll, roll_rate = roll + lean(t), roll_rate + lean.derivative()(t)
    return hermite(t, roll, roll_rate), hermite(t, pitch - (chord - slope),
                                                pitch_rate - (chord_by_path - slope_by_path) * v)


def side_force(speed: Profile, yaw_rate: Profile, lean: Profile | None, t: Floats) -> Floats:
    """Return the tyre force to the left divided by the mass at times t, m/s^2."""
    return speed(t) * yaw_rate(t) + (G * np.sin(lean(t)) if lean else 0.0)


def kneeling_degree(speed: Profile, t: Floats) -> Floats:
    """Return the degree of kneeling of a bus at its stops, 0 to 1: (n,)."""
    still = np.concatenate([[0], np.abs(speed(t)) < STILL, [0]]).astype(int)
    begin, end = (np.flatnonzero(np.diff(still) == sign) for sign in (1, -1))
    down = np.zeros(len(t))
    for a, b in zip(t[begin[1:-1]], t[end[1:-1] - 1], strict=True):
        down += np.clip(np.minimum(t - a, b - t) / KNEELING_TIME, 0.0, 1.0)
    return down


def road_lean(speed: Profile, yaw_rate: Profile, real: Real) -> Profile:
    """Return the lean of the road to the right by time, rad."""
    step = 0.005 if real.kerbs else 0.02    # s, as above
    t = np.round(np.arange(0.0, speed.end + step, step), 9)
    cross = Hills(real.cross_slope, real.cross_slope_length)
    lean = (real.crossfall + cross(speed.integral()(t))[0]
            - real.banking * np.arctan(speed(t) * yaw_rate(t) / G))
    return hermite(t, lean, np.gradient(lean, step))


def sprung_response(push: Floats, step: float) -> tuple[Floats, Floats]:
    """
    Return value and rate, (n,) each, of ``y'' + 2 z w y' + w^2 y = w^2 u`` from rest.

    push : (n,) u, the static tilt, rad, linear between rows.   step : s, between rows.
    """
    w, z = FREQUENCY, DAMPING
    wd = w * np.sqrt(1 - z**2)
    decay, s, c = np.exp(-z * w * step), np.sin(wd * step), np.cos(wd * step)
    a, b = decay * (c + z * w / wd * s), decay * s / wd
    d = decay * (c - z * w / wd * s)
    slope = np.diff(push) / step
    begin = push[:-1] - 2 * z / w * slope     # steady response to a ramp
    y, dy = np.empty(len(push)), np.empty(len(push))
    now, rate = float(push[0]), 0.0
    y[0], dy[0] = now, rate
    for k, (base, rise) in enumerate(zip(begin.tolist(), slope.tolist(), strict=True)):
        off, off_rate = now - base, rate - rise
        now = base + rise * step + a * off + b * off_rate
        rate = rise - b * w * w * off + d * off_rate
        y[k + 1], dy[k + 1] = now, rate
    return y, dy


def lateral_velocity(speed: Profile, yaw_rate: Profile, sideslip: float, lean: Profile | None,
                     t: Floats) -> Floats:
    """Return the velocity to the left at times t, m/s: against the force of the tyres."""
    return -sideslip * side_force(speed, yaw_rate, lean, t) * np.abs(speed(t))


def rotation(motion: Motion, t: Floats) -> Floats:
    """Return the rotations from the body axes to the vehicle axes at (n,) times: (n, 3, 3)."""
    roll, pitch = (profile(t) for profile in motion.tilt)
    return matrix_from_rpy(np.stack([roll, pitch, np.zeros_like(roll)], -1))


def imu_output(motion: Motion, state: State,
               lever_arm: Floats | tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return turn rate, rad/s, and specific force, m/s^2, in body axes; lever arm at rest, m."""
    w_v, f_v = inertial_v(state, lever_arm)
    if not motion.tilt:
        return w_v, f_v
    t, arm = state.t, np.asarray(lever_arm, dtype=float)
    R = rotation(motion, t)
    roll, rates = motion.tilt[0](t), [profile.derivative() for profile in motion.tilt]
    dr, dp = (rate(t) for rate in rates)
    ddr, ddp = (rate.derivative().mean(t) for rate in rates)
    s, c = np.sin(roll), np.cos(roll)
    # turn rate of the body relative to the vehicle, in body axes, and its derivative
    w_r = np.stack([dr, dp * c, -dp * s], -1)
    dw_r = np.stack([ddr, ddp * c - dp * dr * s, -ddp * s - dp * dr * c], -1)
    arm_v = R @ arm
    w_rv = np.einsum('nij,nj->ni', R, w_r)
    moved, turning = arm_v - arm, np.cross(w_rv, arm_v)
    # the arm moved by the tilt: Euler, centrifugal and Coriolis terms
    dw_v = np.gradient(w_v, t, axis=0) if len(t) > 1 else np.zeros_like(w_v)
    f_v = (f_v + np.cross(dw_v, moved) + np.cross(w_v, np.cross(w_v, moved))
           + 2 * np.cross(w_v, turning) + np.cross(np.einsum('nij,nj->ni', R, dw_r), arm_v)
           + np.cross(w_rv, turning))
    return np.einsum('nij,ni->nj', R, w_v) + w_r, np.einsum('nij,ni->nj', R, f_v)
