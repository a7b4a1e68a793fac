# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Diagnostics of a fit: noise, outliers, clocks and filters, a scale that varies, lever arms.

``remarks`` returns the reasons, ``find_errors_beyond_fit`` errors that the fit does not contain.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.budget import HEIGHT_UNKNOWN
from odocal_ros.calib.number_text import differing
from odocal_ros.data.arrays import Floats, runs
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.factors.factor import ACCEL_STEP, GYRO_STEP
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import imperfection_sigmas
from odocal_ros.estimator.problem import Problem
from odocal_ros.nav.geodesy import SEMI_MAJOR_AXIS
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import FAULT_SIGMAS, FIX_NOISE_LIMIT, INFORMED_SHARE, REMARK_SIGMAS
from odocal_ros.settings.nominal import grade_of

CLOCKS = {'fix': layout.GNSS_CLOCK, 'odometer': layout.ODO_CLOCK}
IMU_SCALES = tuple(i for i, name in enumerate(layout.CONSTANTS) if name.startswith(
    ('gyro_scale', 'accelerometer_scale')))
ACCEL_AXES = layout.constants_from('accelerometer_axis_xy', 'accelerometer_axis_yz')
IMU_ERROR_LIMIT = 4.0       # statistical: sigmas of the grade, for scales and axes
# F of (S31), relative, rad, rad: physical, a body on springs in a second (docs/conventions.md)
MODEL_FLOOR = np.array([6e-6, np.deg2rad(2e-3), np.deg2rad(5e-3)])
SPEED_SCALE_REMEDY = ('Possible causes: truncated speed values, a dead band, or slip of a driven '
                      'wheel at high speed. Tyres have the opposite effect: they grow with speed. '
                      'Use wheel pulses, or a wheel that is not driven.')
STEERED_REMEDY = ('Likely cause: the odometer counts wheels that steer, alone or in a mean; in '
                  'turns they travel farther. Use wheels that do not steer, or correct turns '
                  'with scale_by_curvature (calibration.json).')
# judgement: variance factor of a bias walk that is a step: 480 and more, without at most 7.3
# (docs/decisions/0016)
STEP_VARIANCE = 100.0
MIN_REPORTED_CHANGE = 3e-4      # relative, rad; judgement, of scale and angles
# judgement: share and number of outliers among the fixes above which they are reported
OUTLIER_SHARE, MIN_REPORTED_OUTLIERS = 0.02, 3
VEHICLE = 15.0, 3.0, 5.0    # m, physical: reach of a lorry from base_link, forward, left, up
POSE_COVARIANCE_REMEDY = ('Uncertainties were increased to match the residuals. Check the map and '
                          'the covariance that this source of positions states.')
POSE_OUTLIER_REMEDY = ('Check the map and the source of positions for jumps. The comparison of '
                       'track and fixes includes these positions.')
LEVER_ARM_AXES = 'Axes: from base_link, x forward, y left, z up.'
CAUSES_OF_ARM_SHIFT = {     # other causes of a deviating lever arm, by its axes
    'xy': 'Slip in turns (skid steering, tracks) also shifts x and y; if that is the cause, keep '
          'the setting.',
    'z': 'Body roll on soft springs, or an antenna mast that bends, also shifts z; if that is the '
         'cause, keep the setting.'}


def map_scale_sigma(problem: Problem, c: Floats, sigma: Floats) -> float:
    """Return the sigma of ln K if positions in a local frame contain wheel odometry, else 0."""
    scale_error = c[layout.FIX_BY_MOTION]
    if not (problem.leg.origin.is_local
            and contains_odometer(scale_error, sigma[layout.FIX_BY_MOTION])):
        return 0.0
    # the map's drift is filtered together with the wheels: within a time constant of the filter
    # it looks like the wheel error, so that there are duration / time constant samples
    duration = problem.leg.t_stop - problem.leg.t_begin
    return float(abs(scale_error) * np.sqrt(np.exp(c[layout.FIX_MOTION_TIME]) / duration))


class ErrorBeyondFit(NamedTuple):
    """An error of a constant that the fit does not contain."""

    constant: int     # index in CONSTANTS
    source: str       # name in the budget
    sigma: float


def find_errors_beyond_fit(problem: Problem, fit: Fit, sigma: Floats,
                           travel_errors: dict[str, float]) -> list[ErrorBeyondFit]:
    """Return errors; sigma : (M,) of the constants.   travel_errors : of ln K, by source."""
    has_height = problem.leg.origin.is_local or not np.isnan(problem.leg.fixes_n[:, 2]).all()
    scale_errors = travel_errors | {
        'wheels_in_positions': map_scale_sigma(problem, fit.state.constants, sigma),
        'height': 0.0 if has_height else HEIGHT_UNKNOWN / SEMI_MAJOR_AXIS}
    # of an angle that changes, a later drive may have either value
    return [ErrorBeyondFit(layout.LN_K, name, size) for name, size in scale_errors.items() if size
            ] + [ErrorBeyondFit(step.constant, 'change_of_mounting', abs(step.size)) for step in
                 fit.constant_steps if step.constant != layout.LN_K and step.is_certain]


def remarks(problem: Problem, fit: Fit, sigma: Floats, sigma_ratio: Floats,
            config: Config) -> list[Reason]:
    """Return reasons; sigma, sigma_ratio : (M,) of the constants, and over the prior sigma."""
    c, duration = fit.state.constants, float(np.ptp(fit.state.t))
    return [*_noise_reasons(problem, fit.levels), *_outlier_reasons(problem, fit),
            *lag_reasons(c[layout.FIX_LAG2], sigma[layout.FIX_LAG2]),
            *odometer_reasons(c[layout.FIX_BY_MOTION], sigma[layout.FIX_BY_MOTION],
                              c[layout.FIX_MOTION_TIME], map_scale_sigma(problem, c, sigma)),
            *(reason for name, i in CLOCKS.items()
              for reason in clock_reasons(name, c[i], sigma[i], duration)),
            *_scale_variation_reasons(fit, sigma), *_change_reasons(fit), *_bias_step_reasons(fit),
            *_imu_reasons(c, sigma, config), *_lever_arm_reasons(c, sigma, sigma_ratio, config)]


def _imu_reasons(c: Floats, sigma: Floats, config: Config) -> list[Reason]:
    """Return the reasons for scale and axis errors of the IMU far beyond its grade."""
    reasons = []
    grade_sigmas = np.maximum(imperfection_sigmas(grade_of(config.imu)), 1e-300)
    error = np.zeros(len(c))        # of significant constants, in sigmas of the grade
    error[layout.IMPERFECTIONS] = np.abs(c[layout.IMPERFECTIONS]) / grade_sigmas
    error *= np.abs(c) > REMARK_SIGMAS * sigma
    skew = float(np.linalg.norm(error[ACCEL_AXES]))
    if skew > IMU_ERROR_LIMIT:
        angle = np.rad2deg(np.linalg.norm(c[ACCEL_AXES][error[ACCEL_AXES] > 0]))
        reasons.append(Reason(
            Code.IMU_AXES_SKEW, f'accelerometer axes are {angle:.2f} deg from perpendicular, '
            f'{skew:.0f} times the sigma of the {config.imu.grade} grade '
            f'(limit {IMU_ERROR_LIMIT:g}); accounted for'))
    worst = max(IMU_SCALES, key=lambda i: error[i])
    if error[worst] > IMU_ERROR_LIMIT:
        name = layout.CONSTANTS[worst].replace('_', ' ')
        setting = 'gyro_scale' if name.startswith('gyro') else 'accel_scale'
        reasons.append(Reason(
            Code.IMU_WORSE_THAN_GRADE, f'the {name} is {100 * c[worst]:+z.1f} % off, '
            f'{error[worst]:.0f} times the sigma of the {config.imu.grade} grade '
            f'(limit {IMU_ERROR_LIMIT:g}); accounted for', f'Set imu.{setting}_sigma '
            f'or imu.grade to its data sheet. If its unit is wrong, set imu.{setting}.'))
    return reasons


def _noise_reasons(problem: Problem, levels: Levels) -> list[Reason]:
    """Return the reason for fix errors, white and correlated, above the stated ones."""
    slow = levels['slow'] * levels.correlation_time / 2 if levels.correlation_time else 0.0
    factor = np.sqrt(levels['fix'] + slow / problem.fix_sigma**2)
    if factor <= FIX_NOISE_LIMIT:
        return []
    text = (f'fix errors (white and time-correlated) are {differing(factor, FIX_NOISE_LIMIT)} '
            f'times as large as their covariance states (limit {FIX_NOISE_LIMIT:g})')
    return [Reason(Code.FIXES_NOISIER_THAN_SAID, text,
                   POSE_COVARIANCE_REMEDY if problem.leg.origin.is_local else '')]


def _outlier_reasons(problem: Problem, fit: Fit) -> list[Reason]:
    """Return the reason for fixes that are outliers."""
    fixes = fit.weighted[Fixes]
    outlier = fixes.weight[:, 0] < 0.5
    count, total = int(outlier.sum()), len(outlier)
    if count < max(MIN_REPORTED_OUTLIERS, OUTLIER_SHARE * total):
        return []
    largest = np.hypot(*fixes.raw[outlier, :2].T).max()
    return [Reason(Code.FIX_OUTLIERS, f'{count} of {total} fixes ({100 * count / total:.0f} %) '
                   f'are outliers, up to {largest:.1f} m from the track; they were down-weighted',
                   POSE_OUTLIER_REMEDY if problem.leg.origin.is_local else '')]


def _scale_variation_reasons(fit: Fit, sigma: Floats) -> list[Reason]:
    """Return the reason for a scale that varies in the leg."""
    ranges, c = np.ptp(fit.weighted[MotionRows].motion.tyre_signals, axis=0), fit.state.constants
    texts, remedies = list[str](), list[str]()
    for i, interval, remedy in (
            (layout.SCALE_BY_SPEED, 'from low to high speed', SPEED_SCALE_REMEDY),
            (layout.SCALE_BY_TIME, 'from start to end', ''),
            (layout.SCALE_BY_LEFT_FORCE, 'from right to left turns', ''),
            (layout.SCALE_BY_CURVATURE, 'from straight travel to the tightest turn',
             STEERED_REMEDY)):
        change, change_sigma = np.array([c[i], sigma[i]]) * ranges[i - layout.TYRES.start]
        if abs(change) > max(REMARK_SIGMAS * change_sigma, MIN_REPORTED_CHANGE):
            texts.append(f'{100 * change:+z.2f} ± {100 * change_sigma:.2f} % {interval}')
            remedies += [remedy] if remedy and change < 0 else []
    text = (f'the scale changes by {" and ".join(texts)}; the stated value is the mean over this '
            'leg, for straight travel')
    return [Reason(Code.SCALE_VARIES, text, ' '.join(remedies))] if texts else []


def _bias_step_reasons(fit: Fit) -> list[Reason]:
    """Return the reason for a bias that steps: the largest step of each sensor."""
    texts = []
    for name, bias, column, unit, unit_factor in (
            ('gyro', fit.state.gyro_bias, GYRO_STEP, 'deg/s', np.rad2deg(1.0)),
            ('accelerometer', fit.state.accel_bias, ACCEL_STEP, 'm/s^2', 1.0)):
        begin, end = runs(fit.variance_factors[:, column] > STEP_VARIANCE).T
        size = np.linalg.norm(bias[end] - bias[begin], axis=1)
        if len(size):
            k = int(np.argmax(size))
            texts.append(f'the {name} bias changes by {unit_factor * size[k]:.2g} {unit} near '
                         f't = {fit.state.t[begin[k]]:.0f} s')
    return [Reason(Code.IMU_BIAS_STEP, '; '.join(texts) + '; estimated before and after')
            ] if texts else []


def _change_reasons(fit: Fit) -> list[Reason]:
    """Return the reason for a scale or mounting that changes in the leg."""
    texts = []
    for step in fit.constant_steps:
        if step.is_certain and abs(step.size) > MIN_REPORTED_CHANGE:
            name = layout.CONSTANTS[step.constant].replace('_', ' ')
            size = f'{100 * step.size:+z.2f} %' if step.constant == layout.LN_K else \
                f'{np.rad2deg(step.size):+z.2f} deg'
            texts.append(f'the {name} changes by about {size} near t = {step.t:.0f} s '
                         f'({abs(step.size) / step.sigma:.0f} sigma)')
    return [Reason(Code.CHANGE_IN_LEG, '; '.join(texts))] if texts else []


def deviating_lever_arms(c: Floats, sigma: Floats) -> set[int]:
    """Return the indices of lever arm axes whose estimates deviate from their settings."""
    axes = (*range(layout.ODO_ARM.start, layout.ODO_ARM.stop - 1),      # not z of the odometer
            *range(layout.GNSS_ARM.start, layout.GNSS_ARM.stop))
    min_size = 0.3     # m
    return {i for i in axes if abs(c[i]) > max(REMARK_SIGMAS * sigma[i], min_size)}


def _lever_arm_reasons(c: Floats, sigma: Floats, sigma_ratio: Floats,
                       config: Config) -> list[Reason]:
    """Return LEVER_ARM_OFF for the lever arms whose estimates deviate from their settings."""
    texts, axes_of = [], defaultdict[tuple[str, str], list[str]](list)
    deviating = deviating_lever_arms(c, sigma)
    for name, arm, indices in (('odometer.lever_arm', config.odometer.lever_arm, layout.ODO_ARM),
                               ('gnss.lever_arm', config.gnss.lever_arm, layout.GNSS_ARM)):
        for i, axis, value, reach in zip(range(indices.start, indices.stop), 'xyz', arm, VEHICLE,
                                         strict=True):
            if i not in deviating:
                continue
            estimated = value + c[i]
            text = f'{estimated:+z.2f} ± {sigma[i]:.2f} m'
            # not among the estimates
            rough = ' (too uncertain for a result)' * bool(sigma_ratio[i] >= INFORMED_SHARE)
            if abs(estimated) > reach:
                texts.append(f'{name} {axis}: {text} is larger than a vehicle, so not plausible')
                action = 'Ignore the estimate of {}: another error causes it.'
            elif any(arm):
                texts.append(f'{name} {axis}: set to {value:+z.2f} m, estimated {text}{rough}')
                action = 'Measure {} again.'
            else:
                texts.append(f'{name} {axis}: not set, estimated {text}{rough}')
                action = 'Measure {} and set it.'
            axes_of[action, name].append(axis)
    actions = [action.format(f'{name} ({", ".join(axes)})')
               for (action, name), axes in axes_of.items()]
    to_measure = {axis for (action, _), axes in axes_of.items() if 'Measure' in action
                  for axis in axes}
    if to_measure:
        actions += [LEVER_ARM_AXES, 'A wrong imu.lever_arm has the same effect: check it too.'
                    if any(config.imu.lever_arm) else
                    'An imu.lever_arm that is not set has the same effect: set it first.',
                    *(x for axes, x in CAUSES_OF_ARM_SHIFT.items() if to_measure & set(axes))]
    return [Reason(Code.LEVER_ARM_OFF, f'{"; ".join(texts)}. The other values assume '
                   'the estimated position', ' '.join(actions))] if texts else []


def lag_reasons(square: float, sigma: float) -> tuple[Reason, ...]:
    """Return FIXES_SMOOTHED if the filter constant of the receiver, s^2, is significant."""
    min_size = 0.1     # s: the age of a fix at 10 Hz is up to this
    if abs(square) <= max(REMARK_SIGMAS * sigma, min_size**2):
        return ()
    process, time = ('fixes are averaged', np.sqrt(square)) if square > 0 else (
        'positions and velocities of the fixes are filtered', np.sqrt(-square / 2))
    return (Reason(Code.FIXES_SMOOTHED, f'{process} with a time constant of about '
                   f'{time:.2f} s; accounted for'),)


def contains_odometer(scale_error: float, sigma: float) -> bool:
    """Return True if the positions contain an odometer, with this scale error and its sigma."""
    min_size = 5e-4    # relative: smaller ones do not change a scale by more than its sigma
    return bool(abs(scale_error) > max(FAULT_SIGMAS * sigma, min_size))


def odometer_reasons(
        scale_error: float, sigma: float, log_time: float, map_sigma: float) -> tuple[Reason, ...]:
    """Return FIXES_FOLLOW_ODOMETER if significant; map_sigma : of ln K, 0 without a map."""
    if not contains_odometer(scale_error, sigma):
        return ()
    return (Reason(
        Code.FIXES_FOLLOW_ODOMETER, 'the fixes contain an odometer with a scale error '
        f'of {100 * scale_error:+z.2f} % ± {100 * sigma:.2f} % (time constant '
        f'{np.exp(log_time):.0f} s), as positions fused with a wheel speed do; accounted for'
        + f', with an uncertainty of the scale of {100 * map_sigma:.2g} %' * bool(map_sigma)),)


def filter_reasons(square: float, sigma: float) -> tuple[Reason, ...]:
    """Return SPEED_FILTERED if the filter constant of the odometer, s^2, is significant."""
    min_size = 0.1     # s: a shorter one has an effect of a centimetre, at 2 m/s^2
    if square <= max(REMARK_SIGMAS * sigma, min_size**2):
        return ()
    return (Reason(Code.SPEED_FILTERED, 'the odometer speed is low-pass filtered with a time '
                   f'constant of about {np.sqrt(square):.2f} s; accounted for'),)


def clock_reasons(name: str, rate: float, sigma: float, duration: float) -> tuple[Reason, ...]:
    """Return CLOCKS_DRIFT if a rate and its effect over ``duration``, s, are significant."""
    if abs(rate) <= REMARK_SIGMAS * sigma or abs(rate) * duration <= 0.01:    # s: sample intervals
        return ()
    return (Reason(Code.CLOCKS_DRIFT, f'{name} stamps: the clock is {1e6 * abs(rate):.0f} ppm (± '
                   f'{1e6 * sigma:.0f}) {"fast" if rate > 0 else "slow"} relative to the IMU, '
                   f'{abs(rate) * duration:.3f} s in this leg; accounted for'),)
