# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The motion between keyframes, docs/method.md (S5) to (S9): residuals and their derivatives.

Rows of an interval: [position, velocity, attitude, gyro bias, accelerometer bias, odometer]. Each
is the state at the end minus its prediction from the state at the start and the preintegrated
sums. n rotates with the Earth: Coriolis and the rotation of n within the interval are included to
first order of the Earth rate (the remainder is below 1e-8 of the motion). Gravity is that at the
position of the vehicle.
"""

from copy import copy

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.axle import Axle, tyre_signals_at, WALK_SPEED
from odocal_ros.estimator.preintegrate import Intervals
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import (
    ACCEL,
    BA,
    BG,
    BODY_LEAN,
    E,
    GYRO,
    LN_K,
    M,
    ODO_ARM,
    ODO_CLOCK,
    ODO_DELAY,
    ODO_LAG2,
    P,
    PHI,
    PITCH,
    PITCH_CENTRES,
    SCALE_BY_PITCHING,
    SPEED_OFFSET,
    State,
    TYRES,
    V,
    YAW,
)
from odocal_ros.nav.dead_reckoning import gravity_n
from odocal_ros.nav.rotations import exp_so3, level_left, rotate, rotvec, skew, transpose

D = slice(E, E + 3)     # definition: rows of the odometer, after those of the other unknowns
ROWS = D.stop
# judgement: intervals of a hill; faster pitching is a bump of the road, or squat
HILL_INTERVALS = 5
# attributes of Motion with a row for each interval
INTERVAL_ATTRIBUTES = (
    'T', 't_middle', 'C', 'C_end', 'dv', 'dp', 'displacement', 'wheel_displacement', 'by_delay',
    'by_speed_offset', 'lean_accelerations', 'pitch_increments', 'rate_n', 'level_left',
    'half_pitch_variance', 'up_n', 'slope_gradient', 'tyre_signals', 'scale_ratio',
    'displacement_by_state', 'residual')


def moving_mean(x: Floats) -> Floats:
    """Return moving means over HILL_INTERVALS: (K,)."""
    around = np.ones(HILL_INTERVALS)
    return np.convolve(x, around, 'same') / np.convolve(np.ones(len(x)), around, 'same')


def squared_bounce(inclination: Floats, slope: Floats) -> Floats:
    """Return the squared inclination by a bounce of the body, which no wheel counts: (K,)."""
    # it changes both, sway the inclination to the body only, a crest the slope only
    # within limits that keep the root real far from the solution
    squared = (inclination - moving_mean(inclination)) * (slope - moving_mean(slope))
    return np.clip(squared, -0.5, 0.5)


class Motion:
    """
    The interval equations at one state.

    fitted : the state is so close that residuals are noise: the derivative by the scale then
        uses the fitted path, those by IMU errors the fitted signals (signals.py).
    """

    def __init__(self, problem: Problem, state: State, intervals: Intervals,
                 fitted: bool = False) -> None:
        leg, self.axle = problem.leg, Axle(problem, state)
        self.state, self.sums, self.fitted = state, intervals, fitted
        self.uses_speed_steps = leg.uses_speed_steps
        self.angle_covariances = problem.angle_covariances
        T = self.T = intervals.T[:, None]
        self.C, self.C_end = state.C_nb[:-1], state.C_nb[1:]
        self.arm_v = leg.odometer_arm - leg.imu_arm + state.constants[ODO_ARM]
        self.f = state.scale * state.forward
        _, self.left, self.up = state.C_bv.T
        w = leg.origin.earth_rate_n
        W = skew(w)
        dv, dp = rotate(self.C, intervals.dv), rotate(self.C, intervals.dp)
        half = np.eye(3) - W * T[:, :, None] / 2         # n at mid interval
        p, v = state.p_n, state.v_n
        moved = p[1:] - p[:-1]
        self.displacement_by_state = moved + (self.C_end - self.C) @ (state.C_bv @ self.arm_v)
        along = self.f + self._vary_axis()
        # the odometer measures the path, in any direction of the body
        along *= state.scale / np.linalg.norm(along, axis=1, keepdims=True)
        straight = rotate(half @ self.C, rotate(intervals.S, along))
        self.wheel_displacement = straight * self.scale_ratio * self._inclination_ratio(straight)[
            :, None]
        self.by_delay = self._derivative_by_filter()
        self.displacement = self.wheel_displacement + self.vertical_shift
        # derivative by the offset of a coarse speed
        self.by_speed_offset: Floats | None = None
        if leg.travel.coarse is not None:
            moved_s = leg.travel.coarse.time_in_motion(state.t)
            self.by_speed_offset = (self.f_n + self.f_n_end) / 2 * moved_s[:, None]
            self.displacement = self.displacement + self.by_speed_offset * state.constants[
                SPEED_OFFSET]
        self.dv, self.dp = dv, dp
        g = gravity_n((p[:-1] + p[1:]) / 2, leg.origin)
        r_p = moved - (v[:-1] * T + dp - dp @ W.T * T / 3 + g * T**2 / 2
                       - 2 * (v[:-1] * T**2 / 2 + dp * T / 3 + g * T**3 / 6) @ W.T)
        r_v = v[1:] - (v[:-1] + dv - (dv * T - dp) @ W.T + g * T - 2 * moved @ W.T)
        predicted = exp_so3(-w * T) @ self.C @ intervals.R
        r_phi = rotvec(self.C_end @ transpose(predicted))
        e = state.travel_error
        f_n, f_n_end = self.f_n, self.f_n_end
        r_d = self.displacement_by_state - (self.displacement - f_n_end * e[1:, None] + f_n
                                            * e[:-1, None])
        self.residual = np.concatenate(
            [r_p, r_v, r_phi, np.diff(state.gyro_bias, axis=0),
             np.diff(state.accel_bias, axis=0), r_d], axis=1)

    def take(self, rows: slice) -> 'Motion':
        """Return the motion of the intervals of a slice, for derivatives and noises of its own."""
        part = copy(self)
        part.sums = self.sums.take(rows)
        for name in INTERVAL_ATTRIBUTES:
            whole = getattr(self, name)
            setattr(part, name, whole if whole is None else whole[rows])
        return part

    @property
    def turning(self) -> Floats:
        """Return the sizes of the mean turn rates about up: (K,) rad/s."""
        out: Floats = np.abs(np.einsum('ki,ki->k', self.C[:, 2], self.sums.mean_rate))
        return out

    @property
    def f_n(self) -> Floats:
        """Return the forward axis times the scale at the begins: (K, 3)."""
        return self.C @ self.f

    @property
    def f_n_end(self) -> Floats:
        """Return the same at the ends: (K, 3)."""
        return self.C_end @ self.f

    @property
    def by_pitch_centre(self) -> Floats:
        """Return the derivatives of the path by the centres of pitch: (K, 3, 2)."""
        out: Floats = (self.C @ self.up)[:, :, None] * self.pitch_increments[:, None]
        return out

    @property
    def vertical_shift(self) -> Floats:
        """Return the vertical displacement of the odometer by pitching: (K, 3) m."""
        return self.by_pitch_centre @ self.state.constants[PITCH_CENTRES]

    def _vary_axis(self) -> Floats:
        """Return the change of the scaled forward axis, (K, 3), (S11), (S12); set its signals."""
        state, T, c = self.state, self.T, self.state.constants
        self.lean_accelerations = self.axle.accelerations()
        speed = np.linalg.norm(self.sums.S @ self.f, axis=1) / T[:, 0]
        self.t_middle = (state.t[1:] + state.t[:-1]) / 2
        self.tyre_signals = tyre_signals_at(
            speed, self.t_middle - state.t[0],
            self.axle.acceleration()) - self.axle.means_by_path(self.sums)
        self.half_pitch_variance = np.maximum(
            self.left @ self.angle_covariances @ self.left, 0.0) / 2
        self.scale_ratio = 1 + self.tyre_signals @ c[TYRES, None] + self.half_pitch_variance[
            :, None] * c[SCALE_BY_PITCHING]
        pitch, yaw = (self.lean_accelerations * c[BODY_LEAN]).reshape(-1, 2, 2).sum(axis=1).T
        # nose down about a point ahead, the odometer goes up; not by turns of a body that rolls
        self.rate_n = rotate(self.C, self.sums.mean_rate)
        self.level_left = level_left(self.C @ state.forward)
        pitch_increments = np.einsum('ki,ki->k', self.rate_n, self.level_left) * T[:, 0]
        # on banked ground a turn of the vehicle pitches it about its own axis
        left = np.einsum('ki,ki->k', self.rate_n, self.C @ self.left) * T[:, 0]
        turned = self.sums.mean_rate @ self.up * T[:, 0]
        self.pitch_increments = np.stack(
            [pitch_increments, pitch_increments - moving_mean(pitch_increments), left
             - pitch_increments, turned], -1)
        return state.scale * (np.outer(pitch, self.up) - np.outer(yaw, self.left))

    def _inclination_ratio(self, straight: Floats) -> Floats:
        """Return the path over its projection on the body axis, (K,); set those of its slope."""
        # the odometer counts the path along the ground, independent of the body pitch by sway or
        # bumps; both projections are shorter by the cosine of their angle
        axis = (self.C + self.C_end) / 2
        self.up_n, ahead = axis @ self.up, axis @ self.state.forward

        def slope(x: Floats) -> tuple[Floats, Floats]:
            along = np.einsum('ki,ki->k', x, ahead)
            size = np.maximum(along**2, (WALK_SPEED * self.T[:, 0])**2)
            return np.einsum('ki,ki->k', x, self.up_n) * along / size, along / size

        of_body, _ = slope(straight)
        inclination, per_metre = slope(self.displacement_by_state)
        self.slope_gradient = inclination * per_metre / (1 + inclination**2)
        bounce = squared_bounce(inclination, self.displacement_by_state[:, 2] * per_metre)
        return np.sqrt((1 + of_body**2 + bounce) / (1 + inclination**2))

    def _derivative_by_slope(self, C: Floats, arm_b: Floats, sign: float) -> Floats:
        """Return derivatives of the path by the position and attitude of an end: (K, 3, 6)."""
        by_turn = np.cross(C @ self.up, self.displacement_by_state) / 2 + sign * np.cross(
            C @ arm_b, self.up_n)
        by = np.concatenate([sign * self.up_n, by_turn], axis=1) * self.slope_gradient[:, None]
        out: Floats = self.wheel_displacement[:, :, None] * by[:, None]
        return out

    def _derivative_by_filter(self) -> Floats:
        """Return the derivatives of the travel by delay and filter of the odometer: (K, 2)."""
        wheel = self.axle.wheel / self.state.scale
        # from the fit: the accelerometer determines it better than the readings
        push = np.gradient(wheel, self.state.t)
        return np.stack([np.diff(wheel), -np.diff(push) / 2], -1)

    def jacobians(self, n: int) -> tuple[Floats, Floats, Floats]:
        """Return derivatives by begin, end and constants: (K, 18, n), (K, 18, n), (K, 18, M)."""
        s, C, state = self.sums, self.C, self.state
        K, T = len(self.T), self.T[:, :, None]
        one = np.broadcast_to(np.eye(3), (K, 3, 3))
        a, b = np.zeros((K, ROWS, n)), np.zeros((K, ROWS, n))
        arm_b = state.C_bv @ self.arm_v
        a[:, P, P], a[:, P, V], a[:, P, PHI] = -one, -one * T, skew(self.dp)
        gyro = np.zeros((K, ROWS, s.R_by_gyro.shape[2]))       # by the gyro's bias and constants
        gyro[:, PHI], gyro[:, V] = C @ s.R_by_gyro, -C @ s.dv_by_gyro
        gyro[:, P], gyro[:, D] = -C @ s.dp_by_gyro, -C @ s.S_by_gyro
        a[:, :, BG] = gyro[:, :, :3]
        # biases change little over HILL_INTERVALS: they do not affect the faster part
        lift = T * (C @ self.up)[:, :, None]
        hills, _, turns, tilted = state.constants[PITCH_CENTRES]
        a[:, D, BG] += lift * ((hills - turns) * rotate(transpose(C), self.level_left)
                               + turns * self.left + tilted * self.up)[:, None]
        a[:, P, BA], a[:, V, BA] = C @ s.AA, C @ s.A
        a[:, V, V], a[:, V, PHI] = -one, skew(self.dv)
        a[:, PHI, PHI] = -one
        a[:, BG, BG] = a[:, BA, BA] = -one
        a[:, D, P], a[:, D, PHI] = -one, skew(C @ arm_b + self.displacement)
        by_begin, by_end = self._derivative_by_slope(C, arm_b, -1.0), self._derivative_by_slope(
            self.C_end, arm_b, 1.0)
        a[:, D, P] += by_begin[:, :, :3]
        a[:, D, PHI] += by_begin[:, :, 3:]
        # on a body with roll, part of the turn about its left axis is not about the level axis
        tilt = self.rate_n[:, 2, None] * level_left(self.level_left)
        a[:, D, PHI] -= (hills - turns) * lift * tilt[:, None]
        a[:, D, E] = -self.f_n
        b[:, P, P] = b[:, V, V] = b[:, PHI, PHI] = b[:, BG, BG] = b[:, BA, BA] = one
        b[:, D, P], b[:, D, PHI], b[:, D, E] = one, -skew(self.C_end @ arm_b), self.f_n_end
        b[:, D, P] += by_end[:, :, :3]
        b[:, D, PHI] += by_end[:, :, 3:]
        return a, b, self._by_constants(gyro)

    def _by_constants(self, gyro: Floats) -> Floats:
        s, C, state = self.sums, self.C, self.state
        c = np.zeros((len(self.T), ROWS, M))
        swing = self.C_end - C
        # the odometer does not count its vertical motion by pitch
        displacement = self.displacement
        if self.fitted:     # without sway and vertical motion, which are road noise
            along = self.wheel_displacement / np.maximum(np.linalg.norm(self.wheel_displacement,
                                                                        axis=1), 1e-6)[:, None]
            displacement = along * np.einsum('ki,ki->k', along, self.displacement_by_state)[:,
                                                                                            None]
        c[:, D, LN_K] = self.vertical_shift - displacement
        by_scale = c[:, D, LN_K] / self.scale_ratio
        c[:, D, TYRES] = by_scale[:, :, None] * self.tyre_signals[:, None]
        c[:, D, SCALE_BY_PITCHING] = by_scale * self.half_pitch_variance[:, None]
        for column, gradient in zip((YAW, PITCH), state.C_bv_gradient, strict=True):
            tilt = np.einsum('ki,ki->k', self.displacement_by_state,
                             (C + self.C_end) @ gradient[:, 2] / 2)
            c[:, D, column] = -(C @ s.S @ (state.scale * gradient[:, 0])) \
                + swing @ gradient @ self.arm_v + self.wheel_displacement * (
                    tilt * self.slope_gradient)[:, None]
        for i, axis in enumerate((self.up, -self.left)):
            turned = C @ s.S @ (state.scale * axis)
            c[:, D, BODY_LEAN.start
              + i:BODY_LEAN.stop:2] = -turned[:, :, None] * self.lean_accelerations[:, None, i::2]
        c[:, D, PITCH_CENTRES] = -self.by_pitch_centre
        c[:, D, ODO_ARM] = swing @ state.C_bv
        if self.by_speed_offset is not None:
            c[:, D, SPEED_OFFSET] = -self.by_speed_offset
        # stamps late by d: the reading at a time is the travel d before it
        ahead = (self.f_n + self.f_n_end) / 2
        c[:, D, [ODO_DELAY, ODO_LAG2]] = -ahead[:, :, None] * self.by_delay[:, None]
        c[:, D, ODO_CLOCK] = c[:, D, ODO_DELAY] * self.t_middle[:, None] - self.wheel_displacement
        if self.uses_speed_steps:   # only the direction of the path is used: independent of these
            c[:, D, [LN_K, ODO_DELAY, ODO_CLOCK, ODO_LAG2, SCALE_BY_PITCHING, SPEED_OFFSET]] = 0.0
            c[:, D, TYRES] = 0.0
        c[:, :, GYRO] = gyro[:, :, 3:]
        c[:, V, ACCEL], c[:, P, ACCEL] = C @ s.F, C @ s.FF
        return c
