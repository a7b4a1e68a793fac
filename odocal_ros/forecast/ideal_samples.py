# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Ideal samples of a planned drive: IMU, odometer and fixes without any error."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.estimator.factors.heading import GIVEN_NOISE, Heading
from odocal_ros.estimator.factors.motion import gravity_n
from odocal_ros.estimator.imu import ImuSteps, keyframes
from odocal_ros.estimator.leg import BEFORE_MARK, EXTERNAL_RATE, ExternalSamples, SmootherLeg
from odocal_ros.estimator.state import M, State
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.nav.alignment import HEADING_LIMIT
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.integral import running_integral
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy, transpose
from odocal_ros.settings.config import Config

SENT = ('heading_topic', 'imu_orientation')


@dataclass(frozen=True, eq=False)
class Ideal:
    """A planned drive as input of the smoother, free of errors."""

    leg: SmootherLeg        # fixes and headings are thinned to one for each keyframe or so
    imu: ImuSteps           # with keyframes
    state: State            # true state at the keyframes
    fixes_in_one: float     # number of planned fixes that each fix of the leg replaces


@dataclass(frozen=True, eq=False)
class _Motion:
    """Motion of the IMU at t (m,) s: attitude (m, 3, 3), place, velocity, force, rate (m, 3)."""

    t: Floats
    C_nb: Floats
    p_n: Floats
    v_n: Floats
    f_b: Floats
    w_b: Floats
    travel: Floats


def ideal(drive: PlannedDrive, sigmas: Sigmas, spacing: float) -> Ideal:
    """
    Return the samples of a drive without any error.

    drive : as planned. Mounting angles are zero, the scale is 1: sigmas do not depend on them.
    sigmas : lever arms, fix rate and sigma, size of a count, external heading.   spacing : s
    between keyframes.
    """
    config = sigmas.config
    spans = np.array(drive.standstills(config.leg.standstill)).reshape(-1, 2)
    before = [s for s in spans if s[0] <= 0.5 and s[1] >= -BEFORE_MARK]
    t_begin = max(min(0.0, float(before[-1][0])), -config.leg.preroll) if before else 0.0
    origin = Origin(drive.latitude, drive.longitude, drive.height)
    sample_rate = 20.0    # Hz: the noise of a second does not depend on the sample rate
    samples_enough = 50    # samples between keyframes that lie far apart
    rate = min(sample_rate, samples_enough / spacing)
    t = np.linspace(t_begin, drive.duration, max(2, round((drive.duration - t_begin) * rate) + 1))
    motion = _motion(drive, t, origin, config)
    t_fix = _times(t_begin, drive.duration, sigmas.fix_rate, spacing)
    antenna = motion.p_n + motion.C_nb @ np.subtract(config.gnss.lever_arm, config.imu.lever_arm)
    leg = SmootherLeg(
        origin=origin, t_begin=t_begin, t_stop=drive.duration, t_imu=t, w_b=motion.w_b,
        f_b=motion.f_b, travel=Travel(t, motion.travel, sigmas.quantum), t_fix=t_fix,
        fixes_n=np.stack([np.interp(t_fix, t, x) for x in antenna.T], -1),
        covariance_n=np.tile(sigmas.covariance_n, (len(t_fix), 1, 1)), standstills=spans,
        rough_scale=1.0, nominal_scale=1.0, scale_unit='1',
        imu_arm=np.array(config.imu.lever_arm, float),
        odometer_arm=np.array(config.odometer.lever_arm, float),
        antenna_arm=np.array(config.gnss.lever_arm, float),
        external=_heading(drive, config, t_begin, spacing))
    key = keyframes(leg, spacing)
    return Ideal(leg, ImuSteps.between(leg, key), _state(motion, key),
                 max(1.0, (drive.duration - t_begin) * sigmas.fix_rate / len(t_fix)))


def _motion(drive: PlannedDrive, t: Floats, origin: Origin, config: Config) -> _Motion:
    """Return the motion of the IMU in the frame n."""
    speed, yaw, slope = (np.interp(t, drive.t, x) for x in (drive.speed, drive.yaw, drive.slope))
    C_nb = matrix_from_rpy(np.stack([np.zeros_like(yaw), -slope, yaw], -1))
    turn, climb = np.gradient(yaw, t), np.gradient(slope, t)
    w_nb = np.stack([turn * np.sin(slope), -climb, turn * np.cos(slope)], -1)
    arm = np.subtract(config.imu.lever_arm, config.odometer.lever_arm)
    wheel_n = C_nb[:, :, 0] * speed[:, None]
    p_n = running_integral(t, wheel_n) + (C_nb - C_nb[0]) @ arm
    v_n = wheel_n + (C_nb @ np.cross(w_nb, arm)[:, :, None])[:, :, 0]
    earth_n = earth_rate_n(origin.latitude)
    f_n = np.gradient(v_n, t, axis=0) + 2 * np.cross(earth_n, v_n) - gravity_n(p_n, origin)
    C_bn = transpose(C_nb)
    return _Motion(t, C_nb, p_n, v_n, np.einsum('kij,kj->ki', C_bn, f_n), w_nb + C_bn @ earth_n,
                   running_integral(t, speed))


def _times(begin: float, end: float, rate: float, spacing: float) -> Floats:
    """Return times at a rate, at most one for each keyframe, in the middle of their intervals."""
    count = max(1, round((end - begin) * min(rate, 1 / spacing)))
    return begin + (np.arange(count) + 0.5) * (end - begin) / count


def _heading(drive: PlannedDrive, config: Config, t_begin: float, spacing: float
             ) -> dict[str, ExternalSamples]:
    """Return the external heading of the settings; none for a course or a gyrocompass."""
    asked, sigma = config.alignment.source, config.alignment.heading_sigma
    if asked == 'fixed':
        t, noise = np.zeros(1), GIVEN_NOISE
    elif asked in SENT and sigma <= HEADING_LIMIT:
        t = _times(t_begin, drive.duration, EXTERNAL_RATE, spacing)
        noise = sigma * np.sqrt(len(t) / max(1.0, (drive.duration - t_begin) * EXTERNAL_RATE))
    else:
        return {}
    yaw = np.interp(t, drive.t, drive.yaw)
    return {'heading': Heading(t, yaw, np.full(len(t), noise), sigma, asked)}


def _state(motion: _Motion, key: Ints) -> State:
    N = len(key)
    return State(motion.t[key], motion.p_n[key], motion.v_n[key], motion.C_nb[key],
                 np.zeros((N, 3)), np.zeros((N, 3)), np.zeros(N), np.zeros((N, 3)),
                 np.zeros(M)).level()
