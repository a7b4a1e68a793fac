# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The equations of motion between keyframes, docs/method.md (S5) to (S12): residuals, derivatives.

``Motion`` has 18 rows for each interval: position, velocity, attitude, gyro bias and accelerometer
bias at the end minus their predictions from the start and the IMU, and the displacement of the
odometer minus its prediction from the counts; all in n but the biases. n rotates with the Earth:
Coriolis and the rotation of n within the interval are included to first order of the Earth rate
(the remainder is below 1e-8 of the motion). Gravity is that at the position of the vehicle.
"""

from copy import copy

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.axle import Axle, WALK_SPEED
from odocal_ros.estimator.factors.body_tilt import BodyTilt
from odocal_ros.estimator.preintegrate import Intervals
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BA, BG, E, P, PHI, State, V
from odocal_ros.nav.dead_reckoning import gravity_n, Origin
from odocal_ros.nav.rotations import exp_so3, level_left, rotate, rotvec, skew, transpose

# definition: rows of the odometer. The other rows are in the order of the columns of a keyframe:
# P, V, PHI, BG and BA
D = slice(E, E + 3)
ROWS = D.stop
BOUNCE_INTERVALS = 5    # judgement: a slope less their mean is that of a bounce, not of the road
# attributes of Motion with a row for each interval
INTERVAL_ATTRIBUTES = (
    'T', 't_middle', 'C', 'C_end', 'dv', 'dp', 'displacement', 'wheel_displacement', 'by_delay',
    'by_speed_offset', 'pitch_lean', 'yaw_lean', 'by_tilt', 'rate_n', 'level_left',
    'half_pitch_variance', 'up_n', 'slope_gradient', 'tyre_signals', 'scale_ratio',
    'displacement_by_state', 'residual')


def squared_bounce(inclination: Floats, slope: Floats) -> Floats:
    """Return the squared inclination due to a bounce of the body on its springs, (S11a): (K,)."""
    # of the path to the body and to the horizontal: a bounce changes both, sway the former only, a
    # crest the latter only
    window = np.ones(BOUNCE_INTERVALS)

    def changes(x: Floats) -> Floats:
        return x - np.convolve(x, window, 'same') / np.convolve(np.ones(len(x)), window, 'same')
    squared = changes(inclination) * changes(slope)
    return np.clip(squared, -0.5, 0.5)      # keeps the root real far from the solution


class Motion:
    """
    The equations of motion of all K intervals at one state.

    fitted : the state is so close to the solution that residuals are noise. The derivative by the
        scale then uses the fitted path, those by IMU errors the fitted signals (signals.py).

    Attributes are residual (K, 18), and of the odometer's point, in n, (K, 3) m: displacement, by
    the counts, its part wheel_displacement without pitching, and displacement_by_state.
    """

    def __init__(self, problem: Problem, state: State, intervals: Intervals,
                 fitted: bool = False) -> None:
        leg, self.axle = problem.leg, Axle(problem, state)
        self.state, self.sums, self.fitted = state, intervals, fitted
        self.uses_speed_steps = leg.uses_speed_steps
        self.angle_covariances = problem.angle_covariances
        self.brief_accelerations = problem.brief_accelerations
        T = self.T = intervals.T[:, None]
        self.C, self.C_end = state.C_nb[:-1], state.C_nb[1:]
        self.arm_v = leg.odometer_arm - leg.imu_arm + state.constants[layout.ODO_ARM]
        self.f = state.scale * state.forward
        _, self.left, self.up = state.C_bv.T
        self.dv, self.dp = rotate(self.C, intervals.dv), rotate(self.C, intervals.dp)
        self.displacement_by_state = np.diff(state.p_n, axis=0) + (
            self.C_end - self.C) @ (state.C_bv @ self.arm_v)
        along = self.f + self._vary_axis()
        # of length K: the odometer counts the path, whatever its direction in the body
        along *= state.scale / np.linalg.norm(along, axis=1, keepdims=True)
        to_middle = np.eye(3) - skew(leg.origin.earth_rate_n) * T[:, :, None] / 2    # of T, for n
        straight = rotate(to_middle @ self.C, rotate(intervals.S, along))
        self.wheel_displacement = straight * self.scale_ratio * self._inclination_ratio(straight)[
            :, None]
        self.by_delay = self._derivative_by_filter()
        self.displacement = self.wheel_displacement + self.tilt_displacement
        # derivative by the offset of a quantised speed
        self.by_speed_offset: Floats | None = None
        if leg.travel.coarse is not None:
            T_in_motion = leg.travel.coarse.time_in_motion(state.t)
            self.by_speed_offset = (self.f_n + self.f_n_end) / 2 * T_in_motion[:, None]
            self.displacement = self.displacement + self.by_speed_offset * state.constants[
                layout.SPEED_OFFSET]
        self.residual = self._residuals(leg.origin)

    def _residuals(self, origin: Origin) -> Floats:
        """Return the states at the ends minus their predictions, (S5) to (S9): (K, 18)."""
        state, T, dv, dp = self.state, self.T, self.dv, self.dp
        p, v, w = state.p_n, state.v_n, origin.earth_rate_n
        dp_n, W = np.diff(p, axis=0), skew(w)
        g = gravity_n((p[:-1] + p[1:]) / 2, origin)
        r_p = dp_n - (v[:-1] * T + dp - dp @ W.T * T / 3 + g * T**2 / 2
                      - 2 * (v[:-1] * T**2 / 2 + dp * T / 3 + g * T**3 / 6) @ W.T)
        r_v = v[1:] - (v[:-1] + dv - (dv * T - dp) @ W.T + g * T - 2 * dp_n @ W.T)
        r_phi = rotvec(self.C_end @ transpose(exp_so3(-w * T) @ self.C @ self.sums.R))
        e = state.travel_error[:, None]
        r_d = self.displacement_by_state - (self.displacement - self.f_n_end * e[1:]
                                            + self.f_n * e[:-1])
        return np.concatenate(
            [r_p, r_v, r_phi, np.diff(state.gyro_bias, axis=0),
             np.diff(state.accel_bias, axis=0), r_d], axis=1)

    def take(self, rows: slice) -> 'Motion':
        """Return a copy for the intervals of a slice."""
        out = copy(self)
        out.sums = self.sums.take(rows)
        for name in INTERVAL_ATTRIBUTES:
            values = getattr(self, name)
            setattr(out, name, values if values is None else values[rows])
        return out

    @property
    def turning(self) -> Floats:
        """Return the absolute mean turn rates about up: (K,) rad/s."""
        out: Floats = np.abs(np.einsum('ki,ki->k', self.C[:, 2], self.sums.mean_rate))
        return out

    @property
    def f_n(self) -> Floats:
        """Return the forward axis times the scale at the starts of the intervals, in n: (K, 3)."""
        return self.C @ self.f

    @property
    def f_n_end(self) -> Floats:
        """Return the forward axis times the scale at their ends, in n: (K, 3)."""
        return self.C_end @ self.f

    @property
    def tilt_displacement(self) -> Floats:
        """Return the displacement of the odometer due to tilt, delta D of (S12): (K, 3) m."""
        return self.by_tilt @ self.state.constants[layout.BODY_TILT]

    @property
    def _leans(self) -> tuple[tuple[Floats, slice], ...]:
        return (self.pitch_lean, layout.PITCH_LEAN), (self.yaw_lean, layout.YAW_LEAN)

    @property
    def lean_angles(self) -> Floats:
        """Return pitch and yaw of the forward axis by PITCH_LEAN, YAW_LEAN, (S12): (2, K) rad."""
        c = self.state.constants
        return np.stack([signals @ c[columns] for signals, columns in self._leans])

    def _vary_axis(self) -> Floats:
        """Return K delta d of (S12), (K, 3), and set the signals of (S11) and (S12)."""
        state, c = self.state, self.state.constants
        self.pitch_lean, self.yaw_lean = self.axle.lean_accelerations(self.sums.mean_rate)
        self.t_middle = (state.t[1:] + state.t[:-1]) / 2
        tyre_signals, reference = self.axle.tyre_signals(self.sums)
        self.tyre_signals = tyre_signals - reference
        self.half_pitch_variance = np.maximum(
            self.left @ self.angle_covariances @ self.left, 0.0) / 2
        self.scale_ratio = 1 + self.tyre_signals @ c[layout.TYRES, None] \
            + self.half_pitch_variance[:, None] * c[layout.SCALE_BY_PITCHING]
        pitch, yaw = self.lean_angles
        tilt = BodyTilt(state, self.sums.mean_rate, self.axle)
        self.rate_n, self.level_left = tilt.rate_n, tilt.level_left
        self.by_tilt = tilt.displacements
        return state.scale * (np.outer(pitch, self.up) - np.outer(yaw, self.left))

    def _inclination_ratio(self, straight: Floats) -> Floats:
        """Return the root of (S11a), (K,); set its derivative by a displacement along up_n."""
        # the odometer counts the path along the ground, whatever the pitch of the body on
        # bumps or by sway; both projections on the body axis are shorter by the cosine of their
        # inclination
        C_mean = (self.C + self.C_end) / 2
        self.up_n, forward_n = C_mean @ self.up, C_mean @ self.state.forward

        def slope(x: Floats) -> tuple[Floats, Floats]:
            """Return the slope of displacements relative to the body, and that per metre up."""
            along = np.einsum('ki,ki->k', x, forward_n)
            size = np.maximum(along**2, (WALK_SPEED * self.T[:, 0])**2)
            return np.einsum('ki,ki->k', x, self.up_n) * along / size, along / size

        wheel_slope, _ = slope(straight)
        inclination, per_metre = slope(self.displacement_by_state)
        self.slope_gradient = inclination * per_metre / (1 + inclination**2)
        bounce = squared_bounce(inclination, self.displacement_by_state[:, 2] * per_metre)
        return np.sqrt((1 + wheel_slope**2 + bounce) / (1 + inclination**2))

    def _derivative_by_slope(self, C: Floats, arm_b: Floats, sign: float) -> Floats:
        """Return derivatives by position and attitude at start or end, sign -1, 1: (K, 3, 6)."""
        by_attitude = np.cross(C @ self.up, self.displacement_by_state) / 2 + sign * np.cross(
            C @ arm_b, self.up_n)
        gradient = np.concatenate([sign * self.up_n, by_attitude],
                                  axis=1) * self.slope_gradient[:, None]
        out: Floats = self.wheel_displacement[:, :, None] * gradient[:, None]
        return out

    def _derivative_by_filter(self) -> Floats:
        """Return the derivatives of the travel by delay and filter of the odometer: (K, 2)."""
        # from the estimated speed and the specific force, which have no rounding error; over the
        # times of the second derivative in ``as_rolled``, as a robot starts within half a second
        state = self.state
        speed = self.axle.wheel_speed / state.scale
        acceleration = np.gradient(speed, state.t) \
            + self.brief_accelerations @ state.forward / state.scale
        return np.stack([np.diff(speed), -np.diff(acceleration) / 2], -1)

    def jacobians(self, n: int) -> tuple[Floats, Floats, Floats]:
        """Return derivatives by start, end and constants: (K, 18, n), (K, 18, n), (K, 18, M)."""
        s, C, state = self.sums, self.C, self.state
        K, T, eye = len(self.T), self.T[:, :, None], np.eye(3)
        J_start, J_end = np.zeros((2, K, ROWS, n))
        arm_b = state.C_bv @ self.arm_v
        J_start[:, P, V], J_start[:, P, PHI], J_start[:, V, PHI] = -eye * T, skew(self.dp), skew(
            self.dv)
        gyro = np.zeros((K, ROWS, s.R_by_gyro.shape[2]))       # by the gyro's bias and constants
        gyro[:, PHI], gyro[:, V] = C @ s.R_by_gyro, -C @ s.dv_by_gyro
        gyro[:, P], gyro[:, D] = -C @ s.dp_by_gyro, -C @ s.S_by_gyro
        J_start[:, :, BG] = gyro[:, :, :3]
        states = np.arange(BA.stop)      # rows and columns of P, V, PHI, BG and BA
        J_start[:, states, states], J_end[:, states, states] = -1.0, 1.0
        # by the pitch of BODY_TILT: a bias changes that on hills and in turns, not that of bumps
        _, left, up = state.C_bv_level.T
        lift = T * (C @ up)[:, :, None]
        hills, _, turns, _, _, tilted = state.constants[layout.BODY_TILT]
        J_start[:, D, BG] += lift * ((hills - turns) * rotate(transpose(C), self.level_left)
                                     + turns * left + tilted * up)[:, None]
        J_start[:, P, BA], J_start[:, V, BA] = C @ s.AA, C @ s.A
        J_start[:, D, P], J_start[:, D, PHI] = -eye, skew(C @ arm_b + self.displacement)
        by_start = self._derivative_by_slope(C, arm_b, -1.0)
        by_end = self._derivative_by_slope(self.C_end, arm_b, 1.0)
        J_start[:, D, P] += by_start[:, :, :3]
        J_start[:, D, PHI] += by_start[:, :, 3:]
        # on a body with roll, part of the turn about its left axis is not about the level axis
        tilt = self.rate_n[:, 2, None] * level_left(self.level_left)
        J_start[:, D, PHI] -= (hills - turns) * lift * tilt[:, None]
        J_start[:, D, E] = -self.f_n
        J_end[:, D, P], J_end[:, D, PHI] = eye, -skew(self.C_end @ arm_b)
        J_end[:, D, E] = self.f_n_end
        J_end[:, D, P] += by_end[:, :, :3]
        J_end[:, D, PHI] += by_end[:, :, 3:]
        return J_start, J_end, self._by_constants(gyro)

    def _by_constants(self, gyro: Floats) -> Floats:
        """Return the derivatives by the constants; gyro : those by gyro bias and GYRO."""
        s, C, state = self.sums, self.C, self.state
        J_c = np.zeros((len(self.T), ROWS, layout.M))
        swing = self.C_end - C
        displacement = self.displacement
        if self.fitted:     # without sway and vertical motion, which are road noise
            length = np.linalg.norm(self.wheel_displacement, axis=1, keepdims=True)
            along = self.wheel_displacement / np.maximum(length, 1e-6)
            displacement = along * np.einsum(
                'ki,ki->k', along, self.displacement_by_state)[:, None]
        # the odometer does not count its displacement by pitching
        J_c[:, D, layout.LN_K] = self.tilt_displacement - displacement
        by_scale = J_c[:, D, layout.LN_K] / self.scale_ratio
        J_c[:, D, layout.TYRES] = by_scale[:, :, None] * self.tyre_signals[:, None]
        J_c[:, D, layout.SCALE_BY_PITCHING] = by_scale * self.half_pitch_variance[:, None]
        for column, gradient in zip(layout.AXES, state.C_bv_gradient, strict=True):
            tilt = np.einsum('ki,ki->k', self.displacement_by_state,
                             (C + self.C_end) @ gradient[:, 2] / 2)
            J_c[:, D, column] = -(C @ s.S @ (state.scale * gradient[:, 0])) \
                + swing @ gradient @ self.arm_v + self.wheel_displacement * (
                    tilt * self.slope_gradient)[:, None]
        # lean about axes that roll
        pitch, yaw = self.lean_angles
        by_roll = state.scale * (np.outer(pitch, -self.left) - np.outer(yaw, self.up))
        J_c[:, D, layout.MEAN_ROLL] -= rotate(C @ s.S, by_roll)
        for axis, (signals, columns) in zip((self.up, -self.left), self._leans, strict=True):
            by_angle = C @ s.S @ (state.scale * axis)
            J_c[:, D, columns] = -by_angle[:, :, None] * signals[:, None]
        J_c[:, D, layout.BODY_TILT] = -self.by_tilt
        J_c[:, D, layout.ODO_ARM] = swing @ state.C_bv
        if self.by_speed_offset is not None:
            J_c[:, D, layout.SPEED_OFFSET] = -self.by_speed_offset
        # a stamp that is late by d belongs to the travel d earlier
        forward = (self.f_n + self.f_n_end) / 2
        by_delay = -forward[:, :, None] * self.by_delay[:, None]
        J_c[:, D, [layout.ODO_DELAY, layout.ODO_LAG2]] = by_delay
        J_c[:, D, layout.ODO_CLOCK] = by_delay[:, :, 0] * self.t_middle[:, None] \
            - self.wheel_displacement
        if self.uses_speed_steps:   # only the direction of the path is used: independent of these
            J_c[:, D, [layout.LN_K, layout.ODO_DELAY, layout.ODO_CLOCK, layout.ODO_LAG2,
                     layout.SCALE_BY_PITCHING, layout.SPEED_OFFSET]] = 0.0
            J_c[:, D, layout.TYRES] = 0.0
        J_c[:, :, layout.GYRO] = gyro[:, :, 3:]
        J_c[:, V, layout.ACCEL], J_c[:, P, layout.ACCEL] = C @ s.F, C @ s.FF
        return J_c
