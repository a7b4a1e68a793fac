# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Preparation of a fit: screened samples to a leg; a leg to keyframes, priors and levels."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.equations import EXTERNAL_FACTORS, FACTORS
from odocal_ros.estimator.factors.axle import mean_rates_at, WARM_TIME
from odocal_ros.estimator.factors.gnss import inverse_cholesky
from odocal_ros.estimator.factors.interval_noise import total_turn
from odocal_ros.estimator.factors.odometer import brief_accelerations
from odocal_ros.estimator.factors.pseudo_observations import SHARED
from odocal_ros.estimator.imu import (
    ImuSteps,
    is_standing,
    sample_noise,
    white_noise_at_rest,
    without_accelerometer,
)
from odocal_ros.estimator.leg import BEFORE_MARK, drift_time, FIX_RATE, SmootherLeg, thinning
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import (
    G,
    Grade,
    grade_of,
    nominal_scale,
    nominal_yaw,
    turn_on_bias,
    with_grade_by_noise,
)

# s between keyframes. Tuned: half of it costs half as much time again, twice makes the sigmas of a
# consumer IMU 6 % larger (docs/decisions/0005)
SPACING = 1.0
# rad, physical: roads fall by 2 to 2.5 % to the side for drainage, most of a leg to the same one
MEAN_ROLL_SIGMA = 0.02
# m/rad, physical: a pitch centre 1.4 m ahead of the odometer times a mean roll of 1.4 %
LIFT_SIGMA = 0.02
# m, each axis, lower limits of the white and of the correlated error of fixes and of poses.
# Physical: the best receivers of today, motion capture
MIN_FIX_NOISE, MIN_POSE_NOISE = 0.005, 2e-4
# s, physical: height errors from ionosphere and orbits change by one sigma in this time
HEIGHT_TIME = 900.0


def make_smoother_leg(inputs: Inputs, config: Config, origin: Origin, fixes_n: Floats,
                      spans: Floats, rough_scale: float,
                      t_stop: float | None = None) -> SmootherLeg:
    """
    Return the input of the smoother from screened samples.

    inputs : result of ``screen``.   config : lever arms, nominal scale.   origin : of the frame n.
    fixes_n : (k, 3) fixes in n, m; NaN up where a fix has no height.   spans : (s, 2) standstills,
    s.   rough_scale : metres per unit of travel.   t_stop : end of the used data, s; by default
    the stop mark.
    """
    t_stop = inputs.t_stop if t_stop is None else t_stop
    if not inputs.has_accelerometer:         # level ground is assumed: heights are not used
        fixes_n = fixes_n * np.array([1.0, 1.0, np.nan])
    earlier = [s for s in spans if s[0] <= 0.5 and s[1] >= -BEFORE_MARK]
    t_begin = min(0.0, float(earlier[-1][0])) if earlier else 0.0
    rows = thinning(inputs.t_fix, FIX_RATE)
    imu_arm, odometer_arm, antenna_arm = (np.array(group.lever_arm, float) for group in (
        config.imu, config.odometer, config.gnss))
    return SmootherLeg(
        origin=origin, t_begin=t_begin, t_stop=float(t_stop), t_imu=inputs.t_imu,
        w_b=inputs.w_b, f_b=inputs.f_b, travel=inputs.travel.smoothed(), t_fix=inputs.t_fix[rows],
        fixes_n=fixes_n[rows], covariance_n=inputs.covariance_n[rows],
        rounding_n=inputs.rounding_n[rows], standstills=np.asarray(spans),
        rough_scale=float(rough_scale), nominal_scale=nominal_scale(config, inputs.scale_unit),
        scale_unit=inputs.scale_unit, imu_arm=imu_arm, odometer_arm=odometer_arm,
        antenna_arm=antenna_arm, uncertain_t=inputs.uncertain_t,
        uncertain_sigma=inputs.uncertain_sigma,
        external={kind.name: samples for kind in EXTERNAL_FACTORS
                  if (samples := kind.prepared(inputs, config, origin)) is not None},
        has_accelerometer=inputs.has_accelerometer, wheels=inputs.travels)


def make_problem(leg: SmootherLeg, config: Config, imu: ImuSteps | None = None) -> Problem:
    """Return the estimation problem of a leg; imu : its steps, by default with SPACING."""
    imu = ImuSteps.from_leg(leg, SPACING) if imu is None else imu
    t = imu.t_keyframes
    at_rest = is_standing(leg, t)
    used_fixes = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
    config = replace(config, imu=with_grade_by_noise(
        config.imu, white_noise_at_rest(imu, leg, at_rest)))
    grade = grade_of(config.imu)
    if not leg.has_accelerometer:
        grade = without_accelerometer(grade)
    external = {name: samples.between(t[0], t[-1]) for name, samples in leg.external.items()}
    unshared_constants = {kind.source: kind.constants for kind in EXTERNAL_FACTORS
                          if kind.name in leg.external and kind.name not in SHARED}
    no_height = np.isnan(leg.fixes_n[used_fixes, 2])
    # poses can be from motion capture; fixes and points are less accurate
    is_pose = leg.origin.is_local and not config.reference.points
    problem = Problem(
        leg=leg, imu=imu, grade=grade, priors=_priors(config, grade, leg), used_fixes=used_fixes,
        fix_whitening=inverse_cholesky(leg.covariance_n[used_fixes], no_height), at_rest=at_rest,
        external={name: samples for name, samples in external.items() if len(samples.t)},
        unshared_constants=unshared_constants, total_turn=total_turn(leg, imu),
        correlation_time=config.gnss.correlation_time,
        rate_b=mean_rates_at(t, leg.t_imu, leg.w_b), angle_covariances=imu.angle_covariances(),
        brief_accelerations=brief_accelerations(imu),
        drift_time=drift_time(leg, t), min_fix_sigma=MIN_POSE_NOISE if is_pose else MIN_FIX_NOISE)
    for kind in FACTORS:
        if kind.is_present(problem):
            initial, minimum = kind.initial_levels(problem)
            problem.initial_levels = problem.initial_levels.replaced(**initial)
            problem.min_levels |= minimum
    # samples also contain vibration, most of which cancels within a second: the fit starts with
    # the noise of samples, and decreases the levels
    rows = slice(*np.searchsorted(leg.t_imu, [leg.t_begin, leg.t_stop]))
    problem.vibrating_levels = {name: max(sigma**2, problem.initial_levels[name])
                                for name, sigma in sample_noise(leg, rows).items()}
    return problem


def imperfection_sigmas(grade: Grade) -> Floats:
    """
    Return the usual sigmas of the constants IMPERFECTIONS, 0 without this error: (k,).

    Those of the IMU are from its grade. Receivers that smooth do so over a second. Most have no
    odometer: its usual error is small, with a wide range (SIZE_SPREADS). Clocks differ by
    20 ppm. The scale of tyres changes by 0.25 % from 5 to 30 m/s, by 0.25 % as they warm within
    about ten minutes, by slip of 0.4 % for each m/s^2, and, of one wheel, by 0.05 % for each m/s^2
    in turns, which load or unload it (decisions/0009). The path of an axle differs from that
    along the pitching body by half the square of the pitch. A body pitches by 1.7 deg/g, the rear
    axle of a car slides by 0.3 deg per m/s^2, both with a delay of 0.1 s. Over a crest the body
    pitches about the middle of its wheelbase.
    """
    # two angles: a third one turns the whole frame
    axes = np.sqrt(2) * grade.misalignment_sigma
    usual = {
        'gyro_scale': grade.gyro_scale_sigma, 'gyro_axis': axes,
        'gyro_by_force': grade.gyro_by_force_sigma,       # rad/s per m/s^2
        'accelerometer_scale': grade.accel_scale_sigma, 'accelerometer_axis': axes,
        'fix_lag_square': 1.0,                      # s^2
        'fix_error_by_motion': 1.4e-3,
        'clock_rate': 2e-5,
        'odometer_lag_square': 0.1,                 # s^2
        'scale_by_speed': 1e-4,                     # s/m at FAST_SPEED
        'scale_by_time': 2.5e-3 / WARM_TIME,        # 1 / s
        'scale_by_force': 4e-3,                     # 1 / (m/s^2)
        'scale_by_left_force': 5e-4,                # 1 / (m/s^2)
        # m^2: a car's front axle has -7, the mean of its four wheels -4
        'scale_by_curvature': 4.0,
        'scale_by_pitching': 1.0,                   # per half the squared angle
        'squat': 3e-3, 'sideslip': 5e-3,            # rad per m/s^2
        'squat_by_jerk': 3e-4, 'sideslip_by_jerk': 5e-4,    # rad per m/s^3
        # m: a car's 1.4, a truck's 2.5; in turns 0 of a body that rolls on level ground
        'pitch_centre': 1.5, 'pitch_centre_in_turns': 1.0,
        'body_centre_height': 0.4, 'sway_by_force': 0.005}
    return np.repeat([usual[kind] for kind in layout.KIND_SIZES], list(layout.KIND_SIZES.values()))


def _priors(config: Config, grade: Grade, leg: SmootherLeg) -> layout.Priors:
    """Return the priors of biases and constants."""
    sigma = np.full(layout.M, np.inf)
    sigma[layout.ODO_ARM] = sigma[layout.GNSS_ARM] = max(config.gnss.lever_arm_sigma, 1e-4)
    sigma[layout.ODO_DELAY] = max(config.odometer.time_sigma, 1e-5)
    sigma[layout.GNSS_DELAY] = max(config.gnss.time_sigma, 1e-5)
    sigma[layout.IMPERFECTIONS] = np.maximum(imperfection_sigmas(grade), layout.NO_ERROR)
    # at least the biases of the grade, also for a calibrated IMU: otherwise a bias would be
    # estimated as an axis error, and change the yaw of a tilted IMU
    gyro_bias, accel_bias = map(max, turn_on_bias(config.imu), (grade.gyro_bias, grade.accel_bias))
    # without latitude or north, the unknown Earth rate is a bias too
    if leg.origin.local_earth_rate:
        gyro_bias = float(np.hypot(gyro_bias, max(leg.origin.local_earth_rate.sigma_n)))
    # gravity times the scale error is a bias too
    bias_up = np.hypot(accel_bias, grade.accel_scale_sigma * G)
    accel_bias_sigma = np.maximum([accel_bias, accel_bias, bias_up], 1e-6)
    mean = np.zeros(layout.M)
    sigma[layout.LIFT], sigma[layout.MEAN_ROLL] = LIFT_SIGMA, MEAN_ROLL_SIGMA
    height_sigma = np.sqrt(np.median(leg.covariance_n[:, 2, 2])) if len(leg.t_fix) else 0.0
    sigma[layout.HEIGHT_DRIFT] = max(height_sigma / HEIGHT_TIME, layout.NO_ERROR)
    is_constant = np.isclose(leg.stated_sigma, leg.stated_sigma[:1]).all(axis=0)
    # definition: 1, as the error is in stated sigmas; if these are constant it has no effect
    sigma[layout.FIX_ERROR_BY_SIGMA] = np.where(is_constant, layout.NO_ERROR, 1.0)
    # physical: receivers with an odometer trust it for 5 to 60 s
    mean[layout.FIX_MOTION_TIME], sigma[layout.FIX_MOTION_TIME] = np.log(20.0), 0.7
    # offset of a coarse speed: 0 (rounded) to half a step (truncated)
    middle = leg.travel.coarse.truncation / 2 if leg.travel.coarse else 0.0
    mean[layout.SPEED_OFFSET] = middle
    sigma[layout.SPEED_OFFSET] = middle if middle else layout.NO_ERROR
    for kind in EXTERNAL_FACTORS:
        samples = leg.external.get(kind.name)
        sigma[kind.constants] = (
            layout.NO_ERROR if samples is None else kind.prior_sigmas(samples, config))
    if not leg.has_accelerometer:   # mounting and attitude are not separable: configured mounting
        sigma[layout.ACCEL] = sigma[layout.PITCH] = layout.NO_ERROR
        if 'heading' not in leg.external:
            mean[layout.YAW], sigma[layout.YAW] = nominal_yaw(config), layout.NO_ERROR
    return layout.Priors(np.full(3, max(gyro_bias, 1e-9)), accel_bias_sigma, sigma, mean)
