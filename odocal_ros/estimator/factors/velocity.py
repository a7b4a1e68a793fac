# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The horizontal velocity of the GNSS antenna as rows, docs/method.md (S18).

Derivatives by turn rate and force use means over the interval. With single samples they would
contain vibration: the sigmas of delay and axes, and the lever arm, would be too small.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.fixes import antenna
from odocal_ros.estimator.factors.motion import gravity_n
from odocal_ros.estimator.factors.outside_rows import OutsideRows, Rows
from odocal_ros.estimator.leg import from_place, Outside, thinned
from odocal_ros.estimator.levels import LEAST
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.receiver_filter import smoothing
from odocal_ros.nav.rotations import skew, transpose, turn
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config

# m/s, initial: judgement, 2 m/s^2 times 0.25 s. With less, accelerations look like outliers
FIRST_SIGMA = 0.5
VELOCITY_SIGMA = 0.1      # m/s, initial if a receiver states none: physical, Doppler
# 1 sigma of the delay, s, and of the squared filter time constant, s^2: physical, of receivers
# up to 0.25 s each
TIME_SIGMA, LAG2_SIGMA = 0.25, 0.1


@dataclass(frozen=True, eq=False)
class Velocity(Outside):
    """Horizontal velocity of the antenna, in n: (m, 2) m/s."""

    velocity_n: Floats
    sigma: Floats


class VelocityRows(OutsideRows):
    """Residuals of a velocity (sent less predicted) and their derivatives at one state."""

    name, source = 'velocity', 'fix_velocity'
    levels_of = {'velocity': slice(0, 2)}
    constants = layout.VELOCITY

    @classmethod
    def prepared(cls, inputs: Inputs, config: Config, origin: Origin) -> Velocity | None:
        sent, t = inputs.outside[cls.source]
        # without an accelerometer its change between keyframes is unknown
        if not (config.gnss.use_velocity and len(t) and inputs.has_accelerometer):
            return None
        some = thinned(t)
        t, variance = t[some], sent.variance_n[some, :2]
        known = np.isfinite(variance) & (variance > 0)
        sigma = np.sqrt(np.where(known, variance, VELOCITY_SIGMA**2))
        v_n = (from_place(inputs, t, origin) @ sent.velocity_n[some, :, None])[:, :2, 0]
        return Velocity(t, v_n, sigma)

    @staticmethod
    def prior_sigmas(sent: Velocity, config: Config) -> Floats:
        gnss = config.gnss
        return np.array([np.hypot(TIME_SIGMA, gnss.time_sigma), LAG2_SIGMA,
                         max(gnss.velocity_scale_sigma, 1e-6)])

    def rows(self, problem: Problem, point: LinearisationPoint) -> Rows:
        leg, state, points = problem.leg, point.state, point.points['velocity']
        sent, k = problem.outside['velocity'], points.interval
        assert isinstance(sent, Velocity)
        C, tau = state.C_nb[k], points.tau[:, None]
        C_t = C @ points.R
        arm_v = leg.antenna_arm - leg.imu_arm + state.constants[layout.GNSS_ARM]
        arm_b = state.C_bv @ arm_v
        dv, g = turn(C, points.dv), gravity_n(state.p_n[k], leg.origin)
        swing = turn(C_t, np.cross(points.rate, arm_b))
        _, at_keys = antenna(state, point.intervals.mean_rate, arm_b)
        faster = (np.diff(at_keys, axis=0) / point.intervals.T[:, None])[k]
        smoothed, by_lag = smoothing(state.t, at_keys, np.gradient(at_keys, state.t, axis=0),
                                     state.t[k] + points.tau,
                                     state.constants[layout.VELOCITY_LAG2])
        v = state.v_n[k] + dv + g * tau + swing + smoothed
        # the factor is on the prediction: on the measurement it would also scale its noise, and
        # small factors would fit best
        times = 1 + state.constants[layout.VELOCITY_SCALE]
        m, t, rate = len(k), tau[:, :, None], point.intervals.mean_rate[k]
        measured = np.concatenate([rate, point.intervals.mean_force[k]], axis=1)[:, None]
        J, c = np.zeros((m, 3, layout.BARE)), np.zeros((m, 3, layout.M))
        J[:, :, layout.V] = -np.eye(3)
        J[:, :, layout.PHI] = skew(dv + swing)
        J[:, :, layout.BA] = C @ points.A
        by_gyro, by_rate = -C @ points.dv_by - skew(swing) @ C @ points.turned, -C_t @ skew(arm_b)
        J[:, :, layout.BG] = by_gyro[:, :, :3] + by_rate
        c[:, :, layout.GYRO] = by_gyro[:, :, 3:] + (
            by_rate[:, :, layout.GYRO_AXIS] * measured[:, :, layout.GYRO_SIGNAL])
        by_yaw, by_pitch = state.C_bv_gradient
        W = C_t @ skew(rate)
        c[:, :, layout.YAW], c[:, :, layout.PITCH] = (-W @ (x @ arm_v) for x in (by_yaw, by_pitch))
        c[:, :, layout.GNSS_ARM] = -W @ state.C_bv
        c[:, :, layout.VELOCITY_DELAY], c[:, :, layout.VELOCITY_LAG2] = faster, -by_lag
        force, signals = turn(transpose(C), faster - g), np.zeros((m, 3, len(layout.ACCEL_AXIS)))
        # fitted force, (m, 3) m/s^2, by its axes
        columns = range(len(layout.ACCEL_AXIS))
        signals[:, layout.ACCEL_AXIS, columns] = force[:, layout.ACCEL_SIGNAL]
        c[:, :, layout.ACCEL] = C @ signals * t
        J, c = J[:, :2] * times, c[:, :2] * times
        c[:, :, layout.VELOCITY_SCALE] = -v[:, :2]
        return Rows(sent.velocity_n - times * v[:, :2], J, c, np.asarray(1 / sent.sigma))

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        out: Floats = super().times(problem, constants) - constants[layout.VELOCITY_DELAY]
        return out

    @classmethod
    def first_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        # before the delay is known, residuals are larger
        first, least = super().first_levels(problem)
        sent = problem.outside[cls.name]
        assert isinstance(sent, Velocity)
        sigma = float(np.median(sent.sigma))
        return {name: max(x, (FIRST_SIGMA / sigma)**2) for name, x in first.items()}, least

    @staticmethod
    def least(sent: Velocity) -> dict[str, float]:
        return {'velocity': (LEAST.velocity / float(np.median(sent.sigma)))**2}
