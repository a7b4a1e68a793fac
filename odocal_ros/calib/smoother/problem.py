# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The estimation problem of a leg: keyframes, priors, initial levels, preintegrated samples."""

from dataclasses import dataclass, field, replace

import numpy as np

from odocal_ros.calib.smoother.axle import rates_at, WARM_TIME
from odocal_ros.calib.smoother.equations import FACTORS, Weighted
from odocal_ros.calib.smoother.fixes import whitener
from odocal_ros.calib.smoother.imu_noise import at_rest, shaken, unfelt
from odocal_ros.calib.smoother.imu_steps import ImuSteps
from odocal_ros.calib.smoother.leg import drift_time, SmootherLeg
from odocal_ros.calib.smoother.noise import Levels
from odocal_ros.calib.smoother.odometer_filter import as_rolled
from odocal_ros.calib.smoother.outside import Heading, Velocity, velocity_sigmas
from odocal_ros.calib.smoother.outside_rows import used
from odocal_ros.calib.smoother.point_rows import alike, PointRows
from odocal_ros.calib.smoother.preintegrate import Intervals, Points, preintegrate
from odocal_ros.calib.smoother.slide import turned
from odocal_ros.calib.smoother.speed_steps import SpeedSteps
from odocal_ros.calib.smoother.start import standing
from odocal_ros.calib.smoother.state import (
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
    State,
    VELOCITY,
    YAW,
)
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.coarse_speed import CoarseSpeed
from odocal_ros.settings.config import Config
from odocal_ros.settings.grades import G, Grade, grade_as_seen, turn_on_bias

# s between keyframes. Tuned: half of it costs half as much time again, twice makes the sigmas of a
# consumer's Imu 6 % larger (docs/decisions/0005)
SPACING = 1.0
NO_ERROR = 1e-12        # prior sigma of what there is none of, in any unit


@dataclass(eq=False)
class Problem:
    """A leg made ready: rows, whitening, priors; what stays the same from pass to pass."""

    leg: SmootherLeg
    imu: ImuSteps
    grade: Grade
    priors: Priors
    within: np.ndarray       # (k,) bool, fixes within the keyframes
    use: np.ndarray          # (k,) bool, of these the ones that are used
    root: np.ndarray         # (m, 3, 3) inverse roots of the stated covariances
    still: np.ndarray        # (N,) bool
    outside: dict[str, Velocity | Heading]    # within the keyframes, where there are any
    turned: float            # rad, in turns
    fix_time: float          # s, as gnss.correlation_time: 0 white, NaN to be judged
    rate_b: np.ndarray       # (N, 3) rad/s, measured at the keyframes
    swings: np.ndarray       # (K, 3, 3) rad^2, of the angles within the intervals
    drift_time: np.ndarray   # (K,) s, in which the correlated fix error changes
    first_levels: Levels = field(default_factory=lambda: Levels({}))
    least: dict[str, float] = field(default_factory=dict)     # levels
    shaken: dict[str, float] = field(default_factory=dict)    # initial levels of the IMU
    # velocity, heading, steps of speed: errors that are one
    per_effective: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, leg: SmootherLeg, config: Config, imu: ImuSteps | None = None) -> 'Problem':
        """Return the problem of a leg; ``imu``: its steps, with keyframes of one's own."""
        imu = ImuSteps.of(leg, SPACING) if imu is None else imu
        t = imu.t[imu.key]
        still = standing(leg, t)
        use = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
        grade = grade_as_seen(config.imu, at_rest(imu, leg, still))
        grade = grade if leg.felt else unfelt(grade)
        root = whitener(leg.covariance_n[use], np.isnan(leg.fixes_n[use, 2]))
        made = cls(leg, imu, grade, _priors(config, grade, leg), use, use, root, still,
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

    @property
    def fix_sigma(self) -> float:
        """Return what the fixes usually state, m on a level axis."""
        out: float = np.sqrt(np.median(self.leg.covariance_n[self.use][:, 0, 0]))
        return out

    def judge_effective(self, weighted: Weighted) -> None:
        """Estimate from residuals how many errors of a sensor in a row are one."""
        self.per_effective = {
            name: alike(part) for name, part in weighted.parts.items()
            if name in (*self.outside, SpeedSteps.name) and isinstance(part, PointRows)}

    def sums(self, state: State) -> tuple[Intervals, dict[str, Points]]:
        """Return the sums over all intervals, and to the times of rows by their part."""
        leg, c = self.leg, state.constants
        times = {part.name: part.times(self, c) for part in FACTORS
                 if issubclass(part, PointRows) and part.there(self)}
        all_t = np.concatenate(list(times.values()))
        order = np.argsort(all_t, kind='stable')
        intervals, points = preintegrate(
            self.imu, state.gyro_bias[:-1], state.accel_bias[:-1],
            as_rolled(leg.travel, c), state.scale * state.forward, all_t[order], c)
        place = np.split(np.argsort(order, kind='stable'),
                         np.cumsum([len(t) for t in times.values()])[:-1])
        return intervals, {name: points.take(own) for name, own in zip(
            times, place, strict=True)}


def imperfect_sigmas(grade: Grade) -> Floats:
    """
    Return the sigmas of IMPERFECT, 0 for none: (k,).

    Those of the IMU by its grade. A receiver that smooths does so over a second;
    most have no odometer (SIZE_SPREADS).
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
    # as Imus are sold, whatever the grade says of one that was calibrated: else a bias would pass
    # for an axis that points off, and the yaw of a tilted Imu with it
    gyro_bias, accel = map(max, turn_on_bias(config.imu), (grade.gyro_bias, grade.accel_bias))
    if leg.origin.local:     # what is not known of the Earth rate is a bias too
        gyro_bias = float(np.hypot(gyro_bias, max(leg.origin.local.sigma_n)))
    # what gravity makes of the scale is a bias too
    up = np.hypot(accel, grade.accel_scale_error * G)
    accel_bias = np.maximum([accel, accel, up], 1e-6)
    centre = np.zeros(M)
    # physical: receivers with an odometer trust it for 5 to 60 s
    centre[FIX_TIME], sigma[FIX_TIME] = np.log(20.0), 0.7
    centre[SPEED_OFFSET], sigma[SPEED_OFFSET] = _offset(leg.travel.coarse)
    sigma[VELOCITY] = velocity_sigmas(config.gnss) if len(leg.velocity.t) else NO_ERROR
    if not leg.felt:        # nothing tells the mounting from the attitude: it is as set
        sigma[ACCEL] = sigma[PITCH] = NO_ERROR
        if not len(leg.heading.t):
            centre[YAW], sigma[YAW] = nominal_yaw(config), NO_ERROR
    return Priors(np.full(3, max(gyro_bias, 1e-9)), accel_bias, sigma, centre)


def nominal_yaw(config: Config) -> float:
    """Return the yaw mounting angle as set, 0 where it is not, rad."""
    yaw = config.imu.nominal_yaw
    return 0.0 if np.isnan(yaw) else yaw


def _offset(coarse: CoarseSpeed | None) -> tuple[float, float]:
    """Return what a speed in steps lacks, and its sigma: none of a step to half of it."""
    half = coarse.truncation / 2 if coarse else 0.0
    return half, half or NO_ERROR
