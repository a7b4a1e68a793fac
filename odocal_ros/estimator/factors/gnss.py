# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The factors of a GNSS receiver: position and horizontal velocity of its antenna.

``Fixes`` are the positions, docs/method.md (S15), (S16), ``VelocityRows`` the velocities, (S18).
Fixes can also be positions of SLAM or motion capture.

Derivatives of the velocity by turn rate and force use means over the interval. With single samples
they would contain vibration: the sigmas of delay and axes, and the lever arm, would be too small.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.point_rows import ExternalRows, PointRows
from odocal_ros.estimator.leg import enu_to_n, ExternalSamples, SmootherLeg, thinning
from odocal_ros.estimator.preintegrate import Points
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.dead_reckoning import gravity_n, Origin
from odocal_ros.nav.receiver_filter import filter_error, odometer_error
from odocal_ros.nav.rotations import rotate, skew, transpose
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config

# m/s, initial sigma of a velocity, whose delay is not known yet: judgement, 2 m/s^2 times 0.25 s.
# With less, accelerations look like outliers
FIRST_SIGMA = 0.5
VELOCITY_SIGMA = 0.1      # m/s, if a receiver states none: physical, Doppler
MIN_VELOCITY_NOISE = 0.005    # m/s, physical: the best receivers of today
# prior sigmas of the delay of a velocity, s, and of the squared time constant of its filter, s^2:
# physical, receivers have up to 0.25 s each
TIME_SIGMA, LAG2_SIGMA = 0.25, 0.1


class Fixes(PointRows):
    """Rows of the fixes: measured minus predicted position of the antenna, ENU, m."""

    name, source = 'fixes', 'fixes'
    level_columns = {'fix': slice(0, 2), 'fix_up': slice(2, 3)}
    share: Floats

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        leg, state, points = problem.leg, point.state, point.points['fixes']
        self.state, self.points, self.whitening = state, points, problem.fix_whitening
        super().__init__(problem, points)
        k, tau = self.k, points.tau[:, None]
        self.t_fix = leg.t_fix[problem.used_fixes]
        self.C = state.C_nb[k]
        dp = self.dp = rotate(self.C, points.dp)
        v, w = state.v_n[k], leg.origin.earth_rate_n
        g = gravity_n(state.p_n[k], leg.origin)
        self.arm_v = leg.antenna_arm - leg.imu_arm + state.constants[layout.GNSS_ARM]
        arm_b = state.C_bv @ self.arm_v
        self.C_nb = self.C @ points.R       # at the fix; C: at the keyframe before
        self.arm_n = self.C_nb @ arm_b
        T = np.diff(state.t)[k]
        self.share = np.clip(points.tau / T, 0.0, 1.0)
        slow = state.slow_n[k] * (1 - self.share)[:, None] \
            + state.slow_n[k + 1] * self.share[:, None]
        self.v_n = v + rotate(self.C, points.dv) + g * tau + rotate(
            self.C_nb, np.cross(point.intervals.mean_rate[k], arm_b))
        imu_n = state.p_n[k] + v * tau + dp + g * tau**2 / 2 - np.cross(w, v) * tau**2
        raw = leg.fixes_n[problem.used_fixes] - imu_n - self.arm_n - slow
        # derivatives by accelerometer errors use the fitted force: noise in the measured one would
        # determine these errors (decision 9)
        fitted = rotate(transpose(self.C), np.diff(state.v_n, axis=0)[k] / T[:, None] - g)
        measured = point.intervals.dv[k] / T[:, None]
        self.force_noise = (fitted - measured) * point.fitted
        # effects of a filter and of an odometer in the receiver, and their derivatives
        track = (state.t, *antenna_motion(state, point.intervals.mean_rate, arm_b),
                 state.t[k] + points.tau)
        smoothed, self.by_lag = filter_error(*track, state.constants[layout.FIX_LAG2])
        added, self.by_motion, self.by_time = odometer_error(
            *track, state.constants[layout.FIX_BY_MOTION], state.constants[layout.FIX_MOTION_TIME])
        stated = leg.stated_sigma[problem.used_fixes]
        # minus the median, as a constant error does not affect the results
        self.by_sigma = stated - np.median(stated, axis=0)
        raw[:, 2] -= state.constants[layout.HEIGHT_DRIFT] * self.t_fix
        raw -= state.constants[layout.FIX_ERROR_BY_SIGMA] * self.by_sigma
        self.raw = np.nan_to_num(raw) - smoothed - added

    def errors(self) -> Floats:
        """Return the fix errors, white plus correlated: (m, 3) m."""
        s, share = self.state.slow_n, self.share[:, None]
        return self.raw + s[self.k] * (1 - share) + s[self.k + 1] * share

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        # by the correlated error of the keyframe before; J_end has that of the keyframe after
        tau = self.points.tau[:, None, None]
        m = len(tau)
        eye = np.eye(3)
        J, J_c = np.zeros((m, 3, n)), np.zeros((m, 3, layout.M))
        J[:, :, layout.P], J[:, :, layout.V] = -eye, -eye * tau
        J[:, :, layout.PHI] = skew(self.dp + self.arm_n)
        J[:, :, layout.BA] = self.C @ self.points.AA
        by_gyro = -self.C @ self.points.dp_by_gyro - skew(
            self.arm_n) @ self.C @ self.points.R_by_gyro
        J[:, :, layout.BG], J_c[:, :, layout.GYRO] = by_gyro[:, :, :3], by_gyro[:, :, 3:]
        if n > layout.SIZE_WITHOUT_SLOW:
            J[:, :, layout.SLOW] = -eye * (1 - self.share)[:, None, None]
        for column, gradient in zip(layout.AXES, self.state.C_bv_gradient, strict=True):
            J_c[:, :, column] = -self.C_nb @ (gradient @ self.arm_v)
        J_c[:, :, layout.GNSS_ARM] = -self.C_nb @ self.state.C_bv
        # a stamp that is late by d belongs to the position d earlier
        J_c[:, :, layout.GNSS_DELAY] = self.v_n
        J_c[:, :, layout.GNSS_CLOCK] = self.v_n * self.t_fix[:, None]
        J_c[:, 2, layout.HEIGHT_DRIFT] = -self.t_fix
        J_c[:, :, layout.FIX_ERROR_BY_SIGMA] = -self.by_sigma[:, :, None] * np.eye(3)
        J_c[:, :, layout.FIX_LAG2] = -self.by_lag
        J_c[:, :, layout.FIX_BY_MOTION] = -self.by_motion
        J_c[:, :, layout.FIX_MOTION_TIME] = -self.by_time
        J_c[:, :, layout.ACCEL] = self.C @ (
            self.points.FF + force_signals(self.force_noise) * tau**2 / 2)
        return J, J_c

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        minimum = (problem.min_fix_sigma / problem.fix_sigma)**2
        return dict.fromkeys(cls.level_columns, 1.0), dict.fromkeys(cls.level_columns, minimum)

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        t = problem.leg.t_fix[problem.used_fixes]
        out: Floats = t - constants[layout.GNSS_DELAY] - constants[layout.GNSS_CLOCK] * t
        return out

    def whiten(self, x: Floats, rows: slice = slice(None)) -> Floats:
        return self.whitening[rows] @ x

    def existing_components(self) -> Bools:
        exists = np.ones((len(self.k), 3), bool)
        exists[:, 2] = self.whitening[:, 2, 2] > 1e-5       # see ``inverse_cholesky``
        return exists


def force_signals(force: Floats) -> Floats:
    """Return derivatives of a force (m, 3) by the accelerometer constants: (m, 3, a) m/s^2."""
    out = np.zeros((*force.shape, len(layout.ACCEL_AXIS)))
    out[:, layout.ACCEL_AXIS, range(out.shape[2])] = force[:, layout.ACCEL_SIGNAL]
    return out


def antenna_motion(state: layout.State, mean_rate: Floats, arm_b: Floats) -> tuple[Floats, Floats]:
    """Return position and velocity of the antenna at the keyframes: (N, 3) m, (N, 3) m/s."""
    rate = np.concatenate([mean_rate[:1], (mean_rate[:-1] + mean_rate[1:]) / 2, mean_rate[-1:]])
    return (state.p_n + state.C_nb @ arm_b,
            state.v_n + rotate(state.C_nb, np.cross(rate, arm_b)))


def inverse_cholesky(covariance_n: Floats, no_height: Bools) -> Floats:
    """Return the inverse Cholesky factors of covariances; a missing height has no weight."""
    C = covariance_n.copy()
    C[no_height, 2, :] = C[no_height, :, 2] = 0.0
    C[no_height, 2, 2] = 1e6**2     # m^2, of a missing height
    return np.linalg.inv(np.linalg.cholesky(C))


@dataclass(frozen=True, eq=False)
class Velocity(ExternalSamples):
    """Horizontal velocity of the antenna."""

    velocity_n: Floats      # (m, 2) m/s, east and north in n


class VelocityRows(ExternalRows):
    """Rows of a GNSS velocity: measured minus predicted, east and north, m/s."""

    name, source = 'velocity', 'fix_velocity'
    level_columns = {'velocity': slice(0, 2)}
    constants, min_sigma = layout.VELOCITY, MIN_VELOCITY_NOISE

    @classmethod
    def prepared(cls, inputs: Inputs, config: Config, origin: Origin) -> Velocity | None:
        samples, t = inputs.external[cls.source]
        # without an accelerometer the change of velocity between keyframes is unknown
        if not (config.gnss.use_velocity and len(t) and inputs.has_accelerometer):
            return None
        rows = thinning(t)
        t, variance = t[rows], samples.variance_n[rows, :2]
        is_stated = np.isfinite(variance) & (variance > 0)
        sigma = np.sqrt(np.where(is_stated, variance, VELOCITY_SIGMA**2))
        v_n = (enu_to_n(inputs, t, origin) @ samples.velocity_n[rows, :, None])[:, :2, 0]
        return Velocity(t, sigma, v_n)

    @staticmethod
    def prior_sigmas(samples: Velocity, config: Config) -> Floats:
        gnss = config.gnss
        return np.array([np.hypot(TIME_SIGMA, gnss.time_sigma), LAG2_SIGMA,
                         max(gnss.velocity_scale_sigma, 1e-6)])

    def rows(self, samples: Velocity, points: Points, point: LinearisationPoint,
             leg: SmootherLeg) -> tuple[Floats, Floats, Floats]:
        state, k = point.state, points.interval
        C, tau = state.C_nb[k], points.tau[:, None]
        C_nb = C @ points.R
        arm_v = leg.antenna_arm - leg.imu_arm + state.constants[layout.GNSS_ARM]
        arm_b = state.C_bv @ arm_v
        dv, g = rotate(C, points.dv), gravity_n(state.p_n[k], leg.origin)
        swing = rotate(C_nb, np.cross(points.rate, arm_b))
        _, v_keys = antenna_motion(state, point.intervals.mean_rate, arm_b)
        acceleration = (np.diff(v_keys, axis=0) / point.intervals.T[:, None])[k]
        smoothed, by_lag = filter_error(state.t, v_keys, np.gradient(v_keys, state.t, axis=0),
                                           state.t[k] + points.tau,
                                           state.constants[layout.VELOCITY_LAG2])
        v = state.v_n[k] + dv + g * tau + swing + smoothed
        # the scale error multiplies the prediction: on the measurement it would also multiply the
        # noise, and a small factor would fit best
        factor = 1 + state.constants[layout.VELOCITY_SCALE]
        m, rate = len(k), point.intervals.mean_rate[k]
        measured = np.concatenate([rate, point.intervals.mean_force[k]], axis=1)[:, None]
        J, J_c = np.zeros((m, 3, layout.SIZE_WITHOUT_SLOW)), np.zeros((m, 3, layout.M))
        J[:, :, layout.V] = -np.eye(3)
        J[:, :, layout.PHI] = skew(dv + swing)
        J[:, :, layout.BA] = C @ points.A
        by_gyro = -C @ points.dv_by_gyro - skew(swing) @ C @ points.R_by_gyro
        by_rate = -C_nb @ skew(arm_b)
        J[:, :, layout.BG] = by_gyro[:, :, :3] + by_rate
        J_c[:, :, layout.GYRO] = by_gyro[:, :, 3:] + (
            by_rate[:, :, layout.GYRO_AXIS] * measured[:, :, layout.GYRO_SIGNAL])
        W = C_nb @ skew(rate)
        for column, gradient in zip(layout.AXES, state.C_bv_gradient, strict=True):
            J_c[:, :, column] = -W @ (gradient @ arm_v)
        J_c[:, :, layout.GNSS_ARM] = -W @ state.C_bv
        J_c[:, :, layout.VELOCITY_DELAY], J_c[:, :, layout.VELOCITY_LAG2] = acceleration, -by_lag
        J_c[:, :, layout.ACCEL] = C @ force_signals(
            rotate(transpose(C), acceleration - g)) * tau[:, :, None]
        J, J_c = J[:, :2] * factor, J_c[:, :2] * factor
        J_c[:, :, layout.VELOCITY_SCALE] = -v[:, :2]
        return samples.velocity_n - factor * v[:, :2], J, J_c

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        out: Floats = super().times(problem, constants) - constants[layout.VELOCITY_DELAY]
        return out

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        initial, minimum = super().initial_levels(problem)
        sigma = float(np.median(problem.external[cls.name].sigma))
        return {name: max(x, (FIRST_SIGMA / sigma)**2) for name, x in initial.items()}, minimum
