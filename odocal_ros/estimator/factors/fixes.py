# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The factor of fixes, docs/method.md (S15), (S16): antenna position after a keyframe."""

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.motion import gravity_n
from odocal_ros.estimator.factors.point_rows import PointRows
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.receiver_filter import odometer_error, smoothing
from odocal_ros.nav.rotations import skew, turn


class Fixes(PointRows):
    """Residuals (fix less prediction) and their derivatives at one state."""

    name, source = 'fixes', 'fixes'
    levels_of = {'fix': slice(0, 2), 'fix_up': slice(2, 3)}
    share: Floats

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        leg, state, points = problem.leg, point.state, point.points['fixes']
        self.state, self.points, self.root = state, points, problem.root
        super().__init__(problem, points)
        k, tau = self.k, points.tau[:, None]
        self.t_fix = leg.t_fix[problem.use]
        self.C = state.C_nb[k]
        dp = turn(self.C, points.dp)
        v = state.v_n[k]
        w = leg.origin.earth_rate_n
        g = gravity_n(state.p_n[k], leg.origin)
        self.arm_v = leg.antenna_arm - leg.imu_arm + state.constants[layout.GNSS_ARM]
        arm_b = state.C_bv @ self.arm_v
        self.C_t = self.C @ points.R
        self.arm_n = self.C_t @ arm_b
        T = np.diff(state.t)[k]
        self.share = np.clip(points.tau / T, 0.0, 1.0)
        slow = state.slow_n[k] * (1 - self.share)[:, None] \
            + state.slow_n[k + 1] * self.share[:, None]
        self.dp = dp
        self.v_n = v + turn(self.C, points.dv) + g * tau + turn(
            self.C_t, np.cross(point.intervals.mean_rate[k], arm_b))
        place = state.p_n[k] + v * tau + dp + g * tau**2 / 2 - np.cross(w, v) * tau**2
        raw = leg.fixes_n[problem.use] - place - self.arm_n - slow
        # of a receiver that smooths the mean age is a delay
        track = (state.t, *antenna(state, point.intervals.mean_rate, arm_b),
                 state.t[k] + points.tau)
        smoothed, self.by_lag = smoothing(*track, state.constants[layout.FIX_LAG2])
        added, self.by_motion, self.by_time = odometer_error(
            *track, state.constants[layout.FIX_BY_MOTION], state.constants[layout.FIX_TIME])
        stated = leg.stated_sigma[problem.use]
        # a constant error does not affect the results
        self.by_sigma = stated - np.median(stated, axis=0)
        raw[:, 2] -= state.constants[layout.HEIGHT_DRIFT] * self.t_fix
        raw -= state.constants[layout.BY_SIGMA] * self.by_sigma
        self.raw = np.nan_to_num(raw) - smoothed - added

    def errors(self) -> Floats:
        """Return the fix errors, white and correlated, at the linearisation point: (m, 3) m."""
        s, share = self.state.slow_n, self.share[:, None]
        return self.raw + s[self.k] * (1 - share) + s[self.k + 1] * share

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        # those by the correlated errors are -(1 - share) before, -share after
        tau = self.points.tau[:, None, None]
        m = len(tau)
        one = np.broadcast_to(np.eye(3), (m, 3, 3))
        J, c = np.zeros((m, 3, n)), np.zeros((m, 3, layout.M))
        J[:, :, layout.P], J[:, :, layout.V] = -one, -one * tau
        J[:, :, layout.PHI] = skew(self.dp + self.arm_n)
        J[:, :, layout.BA] = self.C @ self.points.AA
        by_gyro = -self.C @ self.points.dp_by - skew(self.arm_n) @ self.C @ self.points.turned
        J[:, :, layout.BG], c[:, :, layout.GYRO] = by_gyro[:, :, :3], by_gyro[:, :, 3:]
        if n > layout.BARE:
            J[:, :, layout.SLOW] = -one * (1 - self.share)[:, None, None]
        by_yaw, by_pitch = self.state.C_bv_gradient
        c[:, :, layout.YAW], c[:, :, layout.PITCH] = (
            -self.C_t @ (g @ self.arm_v) for g in (by_yaw, by_pitch))
        c[:, :, layout.GNSS_ARM] = -self.C_t @ self.state.C_bv
        # stamps late by d: the position is that of d earlier
        c[:, :, layout.GNSS_DELAY] = self.v_n
        c[:, :, layout.GNSS_CLOCK] = self.v_n * self.t_fix[:, None]
        c[:, 2, layout.HEIGHT_DRIFT] = -self.t_fix
        c[:, :, layout.BY_SIGMA] = -self.by_sigma[:, :, None] * np.eye(3)
        c[:, :, layout.FIX_LAG2] = -self.by_lag
        c[:, :, layout.FIX_BY_MOTION], c[:, :, layout.FIX_TIME] = -self.by_motion, -self.by_time
        c[:, :, layout.ACCEL] = self.C @ self.points.FF
        return J, c

    @classmethod
    def first_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        least = (problem.fix_least / problem.fix_sigma)**2
        return dict.fromkeys(cls.levels_of, 1.0), dict.fromkeys(cls.levels_of, least)

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        t = problem.leg.t_fix[problem.use]
        # the delay is that at the start mark
        out: Floats = t - constants[layout.GNSS_DELAY] - constants[layout.GNSS_CLOCK] * t
        return out

    def stated(self, rows: Floats, some: slice = slice(None)) -> Floats:
        return self.root[some] @ rows

    def known(self) -> Bools:
        """Return a mask of the components that exist, (m, 3); fixes without height have two."""
        known = np.ones((len(self.k), 3), bool)
        known[:, 2] = self.root[:, 2, 2] > 1e-5
        return known


def antenna(state: layout.State, mean_rate: Floats, arm_b: Floats) -> tuple[Floats, Floats]:
    """Return places and velocities of the antenna at the keyframes, (N, 3) m and m/s."""
    rate = np.concatenate([mean_rate[:1], (mean_rate[:-1] + mean_rate[1:]) / 2, mean_rate[-1:]])
    return (state.p_n + state.C_nb @ arm_b,
            state.v_n + turn(state.C_nb, np.cross(rate, arm_b)))


def whitener(covariance_n: Floats, no_height: Bools) -> Floats:
    """Return inverse Cholesky factors of covariances; without a height only horizontal rows."""
    C = covariance_n.copy()
    C[no_height, 2, :] = C[no_height, :, 2] = 0.0
    C[no_height, 2, 2] = 1e6**2     # m^2, of a missing height
    return np.linalg.inv(np.linalg.cholesky(C))
