# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated legs in the format of the smoother, their results, their true keyframe states."""

from dataclasses import replace

from drives import cached, settings
import numpy as np

from odocal_ros.data.samples import VelocitySamples
from odocal_ros.estimator import make_smoother_leg, smooth, state as layout
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.body_tilt import BodyTilt
from odocal_ros.estimator.factors.motion import D
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.nav.dead_reckoning import mounting_from_forward
from odocal_ros.nav.geodesy import C_en
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.nav.standstill import standstills
from odocal_ros.screening.inputs import locate_fixes
from odocal_ros.screening.screen import screen
from odocal_ros.sim import body, motion
from odocal_ros.sim.noise import make_rng, PHASE, random_walk, stamps
from odocal_ros.sim.options import SIM_GRADES
from odocal_ros.sim.scenarios import SimOptions, simulate

VELOCITY_SIGMA = 0.05      # m/s


@cached
def made(**options):
    """Return a drive, its settings and its leg in the format of the smoother."""
    drive = simulate(SimOptions(**({'scenario': 'town', 'imu_rate': 50.0} | options)))
    # the simulated accelerometer has no scale error unless a test sets one
    config = settings(drive, None, verdict__max_yaw_sigma=0.0087, imu__accel_scale_sigma=0.0,
                      imu__misalignment_sigma=0.0, imu__gyro_by_force_sigma=0.0)
    return drive, config, leg_of(drive.leg(), config)


@cached
def smoothed(**options):
    drive, config, leg = made(**options)
    return drive, smooth(leg, config)


def reason_texts(result):
    return {reason.code: reason.text for reason in result.reasons}


def leg_of(leg, config):
    inputs, _ = screen(leg, config)
    located = locate_fixes(inputs, config)
    spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, located.rough_scale,
                        config.leg.standstill)
    return make_smoother_leg(inputs, config, located.origin, located.fixes_n, spans,
                             located.rough_scale)


def with_velocity(drive, errors, stated=VELOCITY_SIGMA**2):
    """Return the leg with a GNSS velocity at 5 Hz; errors converts (n, 3) draws to m/s."""
    o = drive.options
    ns, t = stamps(drive.motion.duration, 5.0, PHASE['fix'])
    state = drive.motion.at(t)
    swing = np.cross(np.stack([0 * t, 0 * t, state.yaw_rate], -1), o.antenna_lever_arm)
    v = motion.velocity_n(state) + np.einsum('kij,kj->ki', motion.attitude(state), swing)
    v = v + errors(np.random.default_rng(7).standard_normal(v.shape))
    stamp = o.start_ns + ns
    return drive.leg().with_rows(fix_velocity=VelocitySamples(
        stamp, stamp, v, np.full(v.shape, stated)))


def truth(drive, config, leg) -> layout.State:
    """Return the true state at the keyframes of a leg, on level ground."""
    o = drive.options
    imu = make_problem(leg, config).imu
    t = imu.t_keyframes
    since = t + (drive.truth.start_ns - o.start_ns) * 1e-9
    state = drive.motion.at(since)
    to_n = C_en(leg.origin.latitude, leg.origin.longitude).T @ C_en(state.latitude,
                                                                    state.longitude)
    C_nb = to_n @ motion.attitude(state)
    arm_n = C_nb @ np.array(o.imu_lever_arm)
    turning = np.stack([0 * since, 0 * since, state.yaw_rate], -1)
    if drive.motion.tilt:
        C_nb = C_nb @ body.rotation(drive.motion, since)
    C_vb = matrix_from_rpy([o.roll, o.pitch, o.yaw])
    C_nb = C_nb @ C_vb
    v_n = np.einsum('kij,kj->ki', to_n, motion.velocity_n(state))
    p_n = leg.origin.to_n(np.stack([state.latitude, state.longitude, state.height], -1))
    constants = np.zeros(layout.M)
    constants[[layout.LN_K, layout.YAW, layout.PITCH, layout.ODO_DELAY, layout.GNSS_DELAY]] = (
        np.log(o.scale), *mounting_from_forward(C_vb[0]), o.odometer_delay, o.fix_delay)
    v_n = v_n + np.cross(turning, arm_n)
    return layout.State(t, p_n + arm_n, v_n, C_nb, *_biases(drive, since), np.zeros(len(t)),
                 np.zeros((len(t), 3)), constants).with_mean_up()


def _biases(drive, since):
    o, grade = drive.options, SIM_GRADES[drive.options.imu_grade]
    n = len(stamps(drive.motion.duration, o.imu_rate)[0])
    k = np.clip(np.round(since * o.imu_rate).astype(int), 0, n - 1)
    return ((first + random_walk(make_rng(o.seed, name), walk, o.imu_rate, (n, 3)))[k]
            for first, name, walk in (
                (drive.truth.gyro_bias, 'gyro walk', grade.gyro_bias_walk),
                (drive.truth.accel_bias, 'accelerometer walk', grade.accel_bias_walk)))


def at_truth(t_stop=None, **options):
    """Return a drive without noise, and the problem and true state of its leg."""
    drive, config, leg = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0, **options)
    leg = replace(leg, t_stop=t_stop or leg.t_stop)
    return drive, make_problem(leg, config), truth(drive, config, leg)


def pitch_increments(motion):
    """Return ``pitch_increments`` of the tilt of the body in a motion: (K, 4) rad."""
    return BodyTilt(motion.state, motion.sums.mean_rate, motion.axle).pitch_increments


def along_axis(problem, state, axis, constants):
    """Return the odometer residuals along a vehicle axis and their derivatives by constants."""
    part = Equations(problem, state).factors['motion']
    C_vn = np.swapaxes(state.C_nb[:-1] @ state.C_bv, 1, 2)
    return ((C_vn @ part.raw[:, D, None])[:, axis, 0],
            (C_vn @ part.jacobians(layout.SIZE_WITHOUT_SLOW)[2][:, D, constants])[:, axis])
