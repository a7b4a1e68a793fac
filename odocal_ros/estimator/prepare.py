# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Preparation of a leg for the estimator: keyframes, whitening, priors, initial levels."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.equations import FACTORS
from odocal_ros.estimator.factors.axle import rates_at, WARM_TIME
from odocal_ros.estimator.factors.fixes import whitener
from odocal_ros.estimator.factors.outside_rows import used
from odocal_ros.estimator.factors.slide import turned
from odocal_ros.estimator.imu_noise import at_rest, shaken, unfelt
from odocal_ros.estimator.imu_steps import ImuSteps
from odocal_ros.estimator.leg import drift_time, SmootherLeg
from odocal_ros.estimator.outside import velocity_sigmas
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.start import standing
from odocal_ros.estimator.state import (
    ACCEL,
    FIX_TIME,
    GNSS_ARM,
    GNSS_DELAY,
    HEADING,
    IMPERFECT,
    KIND_SIZES,
    M,
    ODO_ARM,
    ODO_DELAY,
    PITCH,
    Priors,
    SPEED_OFFSET,
    VELOCITY,
    YAW,
)
from odocal_ros.nav.coarse_speed import CoarseSpeed
from odocal_ros.settings.config import Config
from odocal_ros.settings.grades import G, Grade, grade_as_seen, turn_on_bias

# s between keyframes. Tuned: half of it costs half as much time again, twice makes the sigmas of a
# consumer IMU 6 % larger (docs/decisions/0005)
SPACING = 1.0
NO_ERROR = 1e-12        # prior sigma of what there is none of, in any unit


def problem_of(leg: SmootherLeg, config: Config, imu: ImuSteps | None = None) -> Problem:
    """Return the problem of a leg; ``imu``: its steps, if keyframes are given."""
    imu = ImuSteps.of(leg, SPACING) if imu is None else imu
    t = imu.t[imu.key]
    still = standing(leg, t)
    use = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
    grade = grade_as_seen(config.imu, at_rest(imu, leg, still))
    grade = grade if leg.felt else unfelt(grade)
    root = whitener(leg.covariance_n[use], np.isnan(leg.fixes_n[use, 2]))
    made = Problem(leg, imu, grade, _priors(config, grade, leg), use, use, root, still,
               used(leg, t), turned(leg, imu), config.gnss.correlation_time,
               rates_at(leg.t_imu, leg.w_b, t), imu.swings(),
               drift_time(leg, t))
    for part in FACTORS:
        if part.there(made):
            first, least = part.first_levels(made)
            made.first_levels = made.first_levels.but(**first)
            made.least |= least
    made.shaken = {k: max(v, made.first_levels[k]) for k, v in shaken(leg).items()}
    return made


def imperfect_sigmas(grade: Grade) -> Floats:
    """
    Return the sigmas of IMPERFECT, 0 for none: (k,).

    Those of the IMU by its grade. A receiver that smooths does so over a second;
    most have no odometer (SIZE_SPREADS). Clocks differ by 20 ppm.
    Tyres change by 0.25 % from 5 to 30 m/s, by 0.25 % as they warm within ten minutes or so, and
    slip by 0.4 % for each m/s^2;
    a body pitches by 1.7 deg/g, a car's rear axle drifts by 0.3 deg per m/s^2, both late by 0.1 s.
    Over a crest it pitches about the middle of its wheelbase.
    """
    axes = np.sqrt(2) * grade.misalignment     # two angles, since one of three turns the frame
    usual = {
        'gyro_scale': grade.gyro_scale_error, 'gyro_axis': axes,
        'gyro_by_force': grade.gyro_by_force,       # rad/s per m/s^2
        'accelerometer_scale': grade.accel_scale_error, 'accelerometer_axis': axes,
        'fix_lag_square': 1.0,                      # s^2
        'fix_error_by_motion': 1.4e-3,
        'clock_rate': 2e-5,
        'odometer_lag_square': 0.1,                 # s^2
        'scale_by_speed': 1e-4,                     # s/m at FAST_SPEED
        'scale_by_time': 2.5e-3 / WARM_TIME,        # 1 / s
        'scale_by_force': 4e-3,                     # 1 / (m/s^2)
        'squat': 3e-3, 'sideslip': 5e-3,            # rad per m/s^2
        'squat_by_jerk': 3e-4, 'sideslip_by_jerk': 5e-4,    # rad per m/s^3
        'pitch_centre': 1.5}                        # m: a car's 1.4, a truck's 2.5
    return np.repeat([usual[kind] for kind in KIND_SIZES], list(KIND_SIZES.values()))


def with_imperfect(priors: Priors, sigmas: Floats) -> Priors:
    """Return priors with these sigmas of imperfections, (k,)."""
    constants = priors.constants.copy()
    constants[IMPERFECT] = sigmas
    return replace(priors, constants=constants)


def _priors(config: Config, grade: Grade, leg: SmootherLeg) -> Priors:
    sigma = np.full(M, np.inf)
    sigma[ODO_ARM] = sigma[GNSS_ARM] = max(config.gnss.lever_arm_sigma, 1e-4)
    sigma[ODO_DELAY] = max(config.odometer.time_sigma, 1e-5)
    sigma[GNSS_DELAY] = max(config.gnss.time_sigma, 1e-5)
    sigma[HEADING] = leg.heading.sigma
    sigma[IMPERFECT] = np.maximum(imperfect_sigmas(grade), NO_ERROR)
    # of IMUs as sold, also for a calibrated one: otherwise a bias would be estimated as an axis
    # error, and change the yaw of a tilted IMU
    gyro_bias, accel = map(max, turn_on_bias(config.imu), (grade.gyro_bias, grade.accel_bias))
    if leg.origin.local:     # an unknown Earth rate is a bias too
        gyro_bias = float(np.hypot(gyro_bias, max(leg.origin.local.sigma_n)))
    # gravity times the scale error is a bias too
    up = np.hypot(accel, grade.accel_scale_error * G)
    accel_bias = np.maximum([accel, accel, up], 1e-6)
    centre = np.zeros(M)
    # physical: receivers with an odometer trust it for 5 to 60 s
    centre[FIX_TIME], sigma[FIX_TIME] = np.log(20.0), 0.7
    centre[SPEED_OFFSET], sigma[SPEED_OFFSET] = _offset(leg.travel.coarse)
    sigma[VELOCITY] = velocity_sigmas(config.gnss) if len(leg.velocity.t) else NO_ERROR
    if not leg.felt:        # mounting and attitude are not separable: as configured
        sigma[ACCEL] = sigma[PITCH] = NO_ERROR
        if not len(leg.heading.t):
            centre[YAW], sigma[YAW] = nominal_yaw(config), NO_ERROR
    return Priors(np.full(3, max(gyro_bias, 1e-9)), accel_bias, sigma, centre)


def nominal_yaw(config: Config) -> float:
    """Return the yaw mounting angle as set, 0 where it is not, rad."""
    yaw = config.imu.nominal_yaw
    return 0.0 if np.isnan(yaw) else yaw


def _offset(coarse: CoarseSpeed | None) -> tuple[float, float]:
    """Return the offset of a coarse speed and its sigma: 0 to half a step."""
    half = coarse.truncation / 2 if coarse else 0.0
    return half, half or NO_ERROR
