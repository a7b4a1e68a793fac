"""
The motion between keyframes: residuals of the Imu and the odometer, their derivatives and noise.

Rows of an interval: [position, velocity, attitude, gyro bias, accelerometer bias, odometer], each
the state at its end less what the state at its begin and the preintegrated sums make of it. n
turns with the Earth, so Coriolis and the turn of n within the interval are taken in to first order
of the Earth rate (what is left is below 1e-8 of the motion), gravity where the vehicle is.
"""

import numpy as np

from odocal_ros.calib.smoother.preintegrate import turn
from odocal_ros.calib.smoother.state import (
    ACCEL_SCALE,
    BA,
    BG,
    C_bv_gradient,
    E,
    GYRO_SCALE,
    LN_K,
    M,
    ODO_ARM,
    ODO_DELAY,
    P,
    PHI,
    PITCH,
    V,
    YAW,
)
from odocal_ros.nav.earth import C_en, earth_rate_n, gravity
from odocal_ros.nav.rotations import exp_so3, skew, transpose

D = slice(15, 18)       # rows of the odometer
ROWS = 18


def rotvec(C):
    """Return the rotation vector of (..., 3, 3), well below pi."""
    axis = np.stack([C[..., 2, 1] - C[..., 1, 2], C[..., 0, 2] - C[..., 2, 0],
                     C[..., 1, 0] - C[..., 0, 1]], -1) / 2
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, (np.trace(C, axis1=-2, axis2=-1) - 1) / 2)
    return axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)[..., None]


def gravity_n(position_n, origin):
    """Return gravity at positions in n, as a vector in n: (N, 3) m/s^2."""
    latitude, longitude, height = origin.to_geodetic(position_n).T
    up_e = C_en(latitude, longitude)[..., 2]
    return -gravity(latitude, height)[:, None] * (up_e @ C_en(origin.latitude, origin.longitude))


class Motion:
    """
    The interval equations at one state.

    change : (K, 3), s: by what the gyro bias and the odometer's delay differ from those that the
    sums were made with (for the others the sums have been shifted).
    """

    def __init__(self, leg, state, intervals, change=(0.0, 0.0)):
        self.state, self.sums = state, intervals
        T = self.T = intervals.T[:, None]
        self.C, self.C_end = state.C_nb[:-1], state.C_nb[1:]
        self.arm_v = leg.odometer_arm - leg.imu_arm + state.constants[ODO_ARM]
        self.f = state.scale * state.forward
        w = earth_rate_n(leg.origin.latitude)
        W = skew(w)
        self.f_n, self.f_n_end = self.C @ self.f, self.C_end @ self.f
        dv, dp = turn(self.C, intervals.dv), turn(self.C, intervals.dp)
        half = np.eye(3) - W * T[:, :, None] / 2         # n at mid interval
        way = intervals.S @ self.f
        if np.any(change[0]):
            way = way + turn(intervals.S_bg, change[0])
        self.way = turn(half @ self.C, way) + self._faster() * change[1]
        self.dv, self.dp = dv, dp
        p, v = state.p_n, state.v_n
        g = gravity_n((p[:-1] + p[1:]) / 2, leg.origin)
        moved = p[1:] - p[:-1]
        r_p = moved - (v[:-1] * T + dp - dp @ W.T * T / 3 + g * T**2 / 2
                       - 2 * (v[:-1] * T**2 / 2 + dp * T / 3 + g * T**3 / 6) @ W.T)
        r_v = v[1:] - (v[:-1] + dv - (dv * T - dp) @ W.T + g * T - 2 * moved @ W.T)
        predicted = exp_so3(-w * T) @ self.C @ intervals.R
        r_phi = rotvec(self.C_end @ transpose(predicted))
        e = state.travel_error
        f_n, f_n_end = self.f_n, self.f_n_end
        swing = turn(self.C_end - self.C,
                     np.broadcast_to(state.C_bv @ self.arm_v, dv.shape))
        r_d = moved + swing - (self.way - f_n_end * e[1:, None] + f_n * e[:-1, None])
        self.residual = np.concatenate(
            [r_p, r_v, r_phi, np.diff(state.gyro_bias, axis=0),
             np.diff(state.accel_bias, axis=0), r_d], axis=1)

    def _faster(self):
        """Return the derivative of the way by a delay of the odometer: (K, 3)."""
        state = self.state
        speed = np.einsum('ki,ki->k', state.v_n, state.C_nb @ state.forward) / state.scale
        return (self.f_n + self.f_n_end) / 2 * np.diff(speed)[:, None]

    def jacobians(self, n):
        """Return derivatives by begin, end and constants: (K, 18, n), (K, 18, n), (K, 18, M)."""
        s, C, state = self.sums, self.C, self.state
        K, T = len(self.T), self.T[:, :, None]
        one = np.broadcast_to(np.eye(3), (K, 3, 3))
        a, b = np.zeros((K, ROWS, n)), np.zeros((K, ROWS, n))
        arm_b = state.C_bv @ self.arm_v
        a[:, P, P], a[:, P, V], a[:, P, PHI] = -one, -one * T, skew(self.dp)
        a[:, P, BG], a[:, P, BA] = -C @ s.dp_bg, C @ s.AA
        a[:, V, V], a[:, V, PHI] = -one, skew(self.dv)
        a[:, V, BG], a[:, V, BA] = -C @ s.dv_bg, C @ s.A
        a[:, PHI, PHI], a[:, PHI, BG] = -one, C @ s.A
        a[:, BG, BG] = a[:, BA, BA] = -one
        a[:, D, P], a[:, D, PHI] = -one, skew(C @ arm_b + self.way)
        a[:, D, BG], a[:, D, E] = -C @ s.S_bg, -self.f_n
        b[:, P, P] = b[:, V, V] = b[:, PHI, PHI] = b[:, BG, BG] = b[:, BA, BA] = one
        b[:, D, P], b[:, D, PHI], b[:, D, E] = one, -skew(self.C_end @ arm_b), self.f_n_end
        return a, b, self._by_constants(a)

    def _by_constants(self, a):
        s, C, state = self.sums, self.C, self.state
        c = np.zeros((len(self.T), ROWS, M))
        yaw, pitch = state.constants[YAW], state.constants[PITCH]
        by_yaw, by_pitch = C_bv_gradient(yaw, pitch)
        swing = self.C_end - C
        c[:, D, LN_K] = -self.way
        for column, gradient in ((YAW, by_yaw), (PITCH, by_pitch)):
            c[:, D, column] = -(C @ s.S @ (state.scale * gradient[:, 0])) \
                + swing @ gradient @ self.arm_v
        c[:, D, ODO_ARM] = swing @ state.C_bv
        # stamps late by d: the reading at a time is the travel d before it
        c[:, D, ODO_DELAY] = -self._faster()
        # a gyro's scale error is a bias in proportion to the turn rate
        c[:, :, GYRO_SCALE] = a[:, :, BG.start + 2] * s.mean_rate[:, 2:]
        c[:, BG, GYRO_SCALE] = 0.0
        c[:, V, ACCEL_SCALE], c[:, P, ACCEL_SCALE] = C @ s.F, C @ s.FF
        return c
