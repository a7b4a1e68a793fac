# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Speed and acceleration of the axle at a state: signals of tyre and body effects, (S11), (S12).

Springs and tyres respond to the acceleration of the axle, not to that of the IMU (docs/method.md).
An IMU half a metre beside the axle also measures half a metre times the angular acceleration as
forward acceleration, with opposite signs in left and right turns. With wheel slip, this would
change the path length.
"""

import numpy as np

from odocal_ros.data.arrays import Floats, iterate_releasing
from odocal_ros.estimator.preintegrate import Intervals
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import (
    FAST_SPEED,
    ODO_ARM,
    SCALE_BY_LEFT_FORCE,
    State,
    TYRES,
)
from odocal_ros.nav.rotations import rotate
from odocal_ros.settings.nominal import G

WALK_SPEED = 1.0     # m/s, judgement: below it, slopes are reduced towards zero
WARM_TIME = 600.0    # s, physical: tyres warm within ten minutes of driving
# definition: weights of the middle of a parabola through seven values (Savitzky and Golay, 1964).
# Judgement: hills and banks last longer; the rest of a tilt is that of the body, on bumps
HILL_WEIGHTS = np.array([-2.0, 3.0, 6.0, 7.0, 6.0, 3.0, -2.0])
RATE_WINDOW = 0.1    # s about a keyframe, judgement: the mean of it contains little vibration


def mean_rates_at(times: Floats, t: Floats, w_b: Floats) -> Floats:
    """Return turn rates at N times, means of the samples within RATE_WINDOW: (N, 3) rad/s."""
    first = np.searchsorted(t, times - RATE_WINDOW / 2)
    end = np.maximum(np.searchsorted(t, times + RATE_WINDOW / 2, side='right'), first + 1)
    return np.stack([w_b[first[k]:end[k]].mean(axis=0)
                     for k in iterate_releasing(range(len(times)))])


def follow_hills(x: Floats) -> Floats:
    """Return the values of parabolas through HILL_WEIGHTS.size intervals at their middle: (K,)."""
    half = HILL_WEIGHTS.size // 2
    filtered, total = (np.convolve(y, HILL_WEIGHTS)[half:half + len(x)]
                       for y in (x, np.ones(len(x))))
    return filtered / total


def separate_tilts(tilt: Floats, acceleration: Floats, path: Floats) -> tuple[Floats, Floats]:
    """
    Return the tilt of the ground, level in the mean, and that of the body on it: (N,) rad each.

    tilt : (N,) rad, of the body in n.   acceleration : (N,) m/s^2, along the axis that tilts up.
    path : (N,) weights of means.
    """
    # tilt of the body = c (acceleration + G * tilt of the ground) + bumps: springs also react to
    # gravity on a slope. c > 0: ground that leans into turns is a bank
    share = path / max(path.sum(), 1e-9)
    deviation = acceleration - share @ acceleration
    by_force = max(share @ (deviation * tilt), 0.0) / max(share @ deviation**2, 1e-9)
    at_rest = tilt - by_force * acceleration
    at_rest = at_rest - share @ at_rest
    ground = follow_hills(at_rest) / (1 + G * by_force)
    return ground, at_rest + by_force * acceleration - ground


def mean_square(begin: Floats, end: Floats, mean: Floats) -> Floats:
    """Return means of the squares of parabolas with these values at the ends, and this mean."""
    both = begin + end
    middle = 6 * mean - 3 * both
    return (both**2 - begin * end) / 3 + middle * both / 6 + middle**2 / 30


class Axle:
    """
    Motion of the origin of base_link, where the axle does not slip sideways, at a state.

    At the keyframes: v_n, (N, 3) m/s, its velocity; turn_rate, (N,) rad/s; left_acceleration,
    (N,) m/s^2; wheel_speed, (N,) m/s, forward, at the odometer.
    """

    def __init__(self, problem: Problem, state: State) -> None:
        self.state = state
        leg = problem.leg
        rate = problem.rate_b - state.gyro_bias
        arm = state.constants[ODO_ARM] - leg.imu_arm

        def velocity_at(arm_v: Floats) -> Floats:
            return state.v_n + rotate(state.C_nb, np.cross(rate, state.C_bv @ arm_v))

        self.v_n = velocity_at(arm)
        # at the keyframe, as the roll: a mean of the intervals beside it precedes and follows a
        # turn by a second, and the difference would be a bank (decisions/0009)
        self.turn_rate: Floats = rate @ state.C_bv[:, 2]
        self.left_acceleration = self._forward_speed(self.v_n) * self.turn_rate
        self.wheel_speed = self._forward_speed(velocity_at(arm + leg.odometer_arm))

    def _forward_speed(self, v_n: Floats) -> Floats:
        speed: Floats = np.einsum('ki,ki->k', v_n, self.state.C_nb @ self.state.forward)
        return speed

    def _slope(self) -> Floats:
        """Return the slope of the road in each interval from the vertical velocity: (K,) rad."""
        # not from the attitude, which contains the pitch mounting angle
        speed, up = self._forward_speed(self.v_n), self.v_n[:, 2]
        double_speed = speed[1:] + speed[:-1]
        return (up[1:] + up[:-1]) * double_speed / np.maximum(double_speed**2, (2 * WALK_SPEED)**2)

    def body_pitch(self) -> Floats:
        """Return the pitch of the body on its springs at the keyframes, nose up: (N,) rad."""
        speed = self._forward_speed(self.v_n)
        return self._tilts(self.state.forward, np.gradient(speed, self.state.t))[1]

    def rolls(self) -> tuple[Floats, Floats]:
        """Return the bank of the road and the roll of the body on it, left side up: (N,) rad."""
        return self._tilts(self.state.C_bv[:, 1], self.left_acceleration)

    def _tilts(self, axis_b: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
        """Return tilts of ground and body along an axis (``separate_tilts``): (N,) rad each."""
        path = np.linalg.norm(self.v_n, axis=1) * np.gradient(self.state.t)
        return separate_tilts(self.state.C_nb[:, 2] @ axis_b, acceleration, path)

    def lean_accelerations(self, mean_rate: Floats) -> tuple[Floats, Floats]:
        """
        Return the signals of PITCH_LEAN and YAW_LEAN in each interval: (K, 3) and (K, 2).

        mean_rate : (K, 3) rad/s in b, mean turn rates.

        Of the pitch: forward acceleration from traction and from braking, m/s^2, and the rate of
        change of their sum, m/s^3. Of the yaw: acceleration to the left and its rate of change.
        They include the components of gravity along a slope and a bank.
        """
        T, speed = np.diff(self.state.t), self._forward_speed(self.v_n)
        left = self.left_force(mean_rate)
        forward = np.diff(speed) / T + G * self._slope()
        # the suspension of an axle reacts differently to its drive and to its brakes
        traction = np.where(forward * (speed[1:] + speed[:-1]) > 0, forward, 0.0)
        forward_jerk, left_jerk = (np.gradient(x) / T if len(T) > 1 else np.zeros_like(x)
                                   for x in (forward, left))
        return (np.stack([traction, forward - traction, forward_jerk], -1),
                np.stack([left, left_jerk], -1))

    def left_force(self, mean_rate: Floats) -> Floats:
        """Return the acceleration to the left and that of gravity on a bank: (K,) m/s^2."""
        # by speed and turn rate: a velocity difference of the axle has the noise of two turn rates
        # times its distance from the IMU, which reduces the estimated sideslip (decisions/0009)
        speed, (bank, _) = self._forward_speed(self.v_n), self.rolls()
        turning = (speed[1:] + speed[:-1]) / 2 * (mean_rate @ self.state.C_bv[:, 2])
        return turning + G * (bank[1:] + bank[:-1]) / 2

    def traction_acceleration(self) -> Floats:
        """Return the acceleration due to traction (positive) and braking, (S11): (K,) m/s^2."""
        # from speeds: in a turn with sideslip the centripetal acceleration has a forward component
        speed = self._forward_speed(self.v_n)
        by_slope: Floats = G * self._slope() * np.sign(speed[1:] + speed[:-1])
        return np.diff(np.abs(speed)) / np.diff(self.state.t) + by_slope

    def tyre_signals(self, sums: Intervals) -> tuple[Floats, Floats]:
        """Return the signals of TYRES in each interval, (K, 6), and where K is stated, (6,)."""
        state = self.state
        path = np.linalg.norm(sums.S @ (state.scale * state.forward), axis=1)
        t = (state.t[1:] + state.t[:-1]) / 2
        signals = tyre_signals_at(path / sums.T, t - state.t[0], self.traction_acceleration(),
                                  self.left_force(sums.mean_rate), mean_square(
                                      self.turn_rate[:-1], self.turn_rate[1:],
                                      sums.mean_rate @ state.C_bv[:, 2]))
        # K is that of the mean speed, time and force, but of straight travel: few drives have the
        # same turns
        reference = path / max(path.sum(), 1e-9) @ signals
        reference[SCALE_BY_LEFT_FORCE - TYRES.start:] = 0.0
        return signals, reference


def tyre_signals_at(speed: Floats, t: Floats, acceleration_along: Floats,
                    left_force: Floats, squared_turn_rate: Floats) -> Floats:
    """Return the signals of TYRES, x of (S11): (..., 6); t : s since the start of the leg."""
    # m/s^2, 1/m: acceleration that rolling and air resistance take from a car at constant speed
    force = acceleration_along + 0.1 + 1e-4 * speed**2
    warm = WARM_TIME * (1 - np.exp(-t / WARM_TIME))
    curvature = squared_turn_rate / np.maximum(speed**2, WALK_SPEED**2)
    return np.stack([speed**2 / (2 * FAST_SPEED), warm, np.maximum(force, 0.0),
                     np.minimum(force, 0.0), left_force, curvature / 2], -1)
