# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The sprung body: accelerations cause pitch and roll, which move the sensors on it.

Roll and pitch are second-order systems, each about the rear axle's centre. Lateral forces of the
rear tyres cause sideslip: the axle's centre moves at an angle to its wheels.
"""

import numpy as np

from odocal_ros.data.arrays import Floats, runs
from odocal_ros.nav.rotations import matrix_from_rpy, rotate, rotate_back
from odocal_ros.sim.motion import Motion, rigid_imu_output, State
from odocal_ros.sim.profile import hermite, Hills, Profile
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.vehicle_distributions import G

# physical: natural frequency of a car's body on its springs, damped by shock absorbers
FREQUENCY = 2 * np.pi * 1.3   # rad/s
DAMPING = 0.3
STILL = 1e-9          # m/s, judgement: rounding
KNEELING_TIME = 2.0   # s, judgement: time in which a bus kneels or rises


def tilts(speed: Profile, yaw_rate: Profile, real: RealEffects, hills: Hills | None = None,
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
    travel = speed.integral()(t)
    # slopes at the rear axle and of the chord of the wheelbase, and derivatives by path length
    slope, slope_by_path, _ = hills(travel)
    chord, chord_by_path = hills.chord(travel, wheelbase) if wheelbase else (slope, slope_by_path)
    forward = speed.derivative().mean(t) + G * slope     # m/s^2
    # nose up is a negative pitch; in a turn to the left the left side goes up
    roll, roll_rate = sprung_response(real.body_roll * side_force(speed, yaw_rate, lean, t)
                                      + real.kneeling * kneeling_degree(speed, t), step)
    braking = np.where(forward * speed(t) < 0, forward, 0.0)
    pitch, pitch_rate = sprung_response(-real.squat * forward - real.brake_dive * braking, step)
    if lean:
        roll, roll_rate = roll + lean(t), roll_rate + lean.derivative()(t)
    return hermite(t, roll, roll_rate), hermite(
        t, pitch - (chord - slope), pitch_rate - (chord_by_path - slope_by_path) * speed(t))


def side_force(speed: Profile, yaw_rate: Profile, lean: Profile | None, t: Floats) -> Floats:
    """Return the tyre force to the left divided by the mass at times t, m/s^2."""
    return speed(t) * yaw_rate(t) + (G * np.sin(lean(t)) if lean else 0.0)


def kneeling_degree(speed: Profile, t: Floats) -> Floats:
    """Return the degree of kneeling of a bus at its stops, 0 to 1: (n,)."""
    degree = np.zeros(len(t))
    for begin, end in t[runs(np.abs(speed(t)) < STILL) - [0, 1]][1:-1]:    # not before and after
        degree += np.clip(np.minimum(t - begin, end - t) / KNEELING_TIME, 0.0, 1.0)
    return degree


def road_lean(speed: Profile, yaw_rate: Profile, real: RealEffects) -> Profile:
    """Return the lean of the road to the right by time, rad."""
    step = 0.005 if real.kerbs else 0.02    # s, as above
    t = np.round(np.arange(0.0, speed.end + step, step), 9)
    cross = Hills(real.alternating_crossfall, real.alternating_crossfall_length)
    lean = (real.constant_crossfall + cross(speed.integral()(t))[0]
            - real.banking * np.arctan(speed(t) * yaw_rate(t) / G))
    return hermite(t, lean, np.gradient(lean, step))


def sprung_response(static_tilt: Floats, step: float) -> tuple[Floats, Floats]:
    """
    Return value and rate, (n,) each, of ``y'' + 2 z w y' + w^2 y = w^2 u`` from rest.

    static_tilt : (n,) u, rad, linear between rows.   step : s, between rows.
    """
    w, z = FREQUENCY, DAMPING
    damped = w * np.sqrt(1 - z**2)      # frequency, rad/s
    decay, sine, cosine = np.exp(-z * w * step), np.sin(damped * step), np.cos(damped * step)
    # transition over a step of the deviation from the steady response, and of its rate
    value_by_value, value_by_rate = decay * (cosine + z * w / damped * sine), decay * sine / damped
    rate_by_rate = decay * (cosine - z * w / damped * sine)
    slopes = np.diff(static_tilt) / step
    steady = static_tilt[:-1] - 2 * z / w * slopes     # response to a ramp
    values, rates = np.empty(len(static_tilt)), np.empty(len(static_tilt))
    value, rate = float(static_tilt[0]), 0.0
    values[0], rates[0] = value, rate
    for k, (base, slope) in enumerate(zip(steady.tolist(), slopes.tolist(), strict=True)):
        deviation, deviation_rate = value - base, rate - slope
        value = base + slope * step + value_by_value * deviation + value_by_rate * deviation_rate
        rate = slope - value_by_rate * w * w * deviation + rate_by_rate * deviation_rate
        values[k + 1], rates[k + 1] = value, rate
    return values, rates


def rotation(motion: Motion, t: Floats) -> Floats:
    """Return the rotations from the body axes to the vehicle axes at (n,) times: (n, 3, 3)."""
    roll, pitch = (profile(t) for profile in motion.tilt)
    return matrix_from_rpy(np.stack([roll, pitch, np.zeros_like(roll)], -1))


def imu_output(motion: Motion, state: State,
               lever_arm: Floats | tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return turn rate, rad/s, and specific force, m/s^2, in body axes; lever arm at rest, m."""
    w_v, f_v = rigid_imu_output(state, lever_arm)
    if not motion.tilt:
        return w_v, f_v
    t, arm = state.t, np.asarray(lever_arm, dtype=float)
    C_vb = rotation(motion, t)
    roll, rates = motion.tilt[0](t), [profile.derivative() for profile in motion.tilt]
    roll_rate, pitch_rate = (rate(t) for rate in rates)
    roll_acceleration, pitch_acceleration = (rate.derivative().mean(t) for rate in rates)
    sine, cosine = np.sin(roll), np.cos(roll)
    # turn rate of the body relative to the vehicle, in body axes, and its derivative
    w_relative = np.stack([roll_rate, pitch_rate * cosine, -pitch_rate * sine], -1)
    dw_relative = np.stack([roll_acceleration,
                            pitch_acceleration * cosine - pitch_rate * roll_rate * sine,
                            -pitch_acceleration * sine - pitch_rate * roll_rate * cosine], -1)
    arm_v = C_vb @ arm
    w_rv = rotate(C_vb, w_relative)
    displacement, tilt_velocity = arm_v - arm, np.cross(w_rv, arm_v)
    # the arm moved by the tilt: Euler, centrifugal and Coriolis terms
    dw_v = np.gradient(w_v, t, axis=0) if len(t) > 1 else np.zeros_like(w_v)
    f_v = (f_v + np.cross(dw_v, displacement) + np.cross(w_v, np.cross(w_v, displacement))
           + 2 * np.cross(w_v, tilt_velocity) + np.cross(rotate(C_vb, dw_relative), arm_v)
           + np.cross(w_rv, tilt_velocity))
    return rotate_back(C_vb, w_v) + w_relative, rotate_back(C_vb, f_v)
