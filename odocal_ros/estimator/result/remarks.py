# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics of a fit: a scale that varies, constants far off their priors, the model's floor."""

from typing import Any

import numpy as np

from odocal_ros.calib.budget import HEIGHT_UNKNOWN
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.factor import ACCEL_STEP, GYRO_STEP
from odocal_ros.estimator.factors.fixes import Fixes
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import imperfect_sigmas
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.filters import (
    by_map_drift,
    clock_reasons,
    follows_odometer,
    lag_reasons,
    odometer_reasons,
)
from odocal_ros.nav.earth import A
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.grades import G, Grade, grade_of
from odocal_ros.settings.levels import FIX_NOISE_LIMIT, INFORMED_SHARE, REMARK_SIGMAS

CLOCKS = {'fix': layout.GNSS_CLOCK, 'odometer': layout.ODO_CLOCK}
IMU_SCALES = tuple(i for i, name in enumerate(layout.CONSTANTS) if name.startswith(
    ('gyro_scale', 'accelerometer_scale')))
AXES = layout.constants_from('accelerometer_axis_xy', 'accelerometer_axis_yz')
AXIS_XY, AXIS_ZX = map(layout.CONSTANTS.index, ('accelerometer_axis_xy', 'accelerometer_axis_zx'))
ANOTHER_IMU = 4.0       # statistical: of the sigma of the grade, for scales and axes
# 1 sigma of what the model does not hold of scale, yaw and pitch: relative, rad, rad. Physical: a
# body on springs within a second (docs/conventions.md)
MODEL_FLOOR = np.array([6e-6, np.deg2rad(2e-3), np.deg2rad(5e-3)])
FALLS_WITH_SPEED = ('Possible causes: truncated speed values, a dead band, or slip of a driven '
                    'wheel at high speed. Tyres have the opposite effect: they grow with speed. '
                    'Use wheel pulses, or a wheel that is not driven.')
# factor on the variance of a second of a bias's walk, judgement: reported steps have 480 and more,
# 60 drives without steps at most 7.3 (docs/decisions/0016)
STEP_VARIANCE = 100.0
# relative, rad, judgement: smaller changes of the scale or of an angle are not reported
LEAST_CHANGE = 3e-4
# share and number of outliers among the fixes that are reported. Judgement
OUTLIER_SHARE, FEWEST_OUTLYING = 0.02, 3
VEHICLE = 15.0, 3.0, 5.0    # m, physical: reach of a lorry from base_link, forward, left, up
OF_POSES = ('Uncertainties were increased to match the residuals. Check the map, and the '
            'covariance that this source of positions states.')
SLIDES = ('Axes: from base_link, x forward, y left, z up. If both arms have the same error, '
          'check imu.lever_arm. Slip in turns (skid steering, tracks) has the same effect; then '
          'keep the setting.')


def beside(value: Floats, covariance: Floats, grade: Grade | None) -> dict[str, Any]:
    """Return additional figures for calibration.json; grade : None without an accelerometer."""
    sigma = np.sqrt(np.diag(covariance))
    # scale_by_speed: the slope at FAST
    out: dict[str, Any] = {name: {'slope': float(value[i]), 'sigma': float(sigma[i]), 'unit': unit}
                 for name, i, unit in (('scale_by_speed', layout.BY_SPEED, '1/(m/s)'),
                                       ('scale_by_time', layout.BY_TIME, '1/s'))}
    if grade is not None:
        for name, angle, axis in (('yaw', layout.YAW, AXIS_XY), ('pitch', layout.PITCH, AXIS_ZX)):
            out[f'{name}_mounting_angle_housing_sigma'] = _figure(
                _of_housing(value[axis], sigma[axis], sigma[angle], grade.misalignment), 'rad')
    next_drive = 1e-3       # physical: by so much tyres differ from drive to drive, warm or cold
    out['scale_ratio_next_drive_sigma'] = _figure(np.hypot(sigma[layout.LN_K], next_drive), '1')
    return out


def _figure(value: float, unit: str) -> dict[str, Any]:
    return {'value': float(value), 'sigma': None, 'unit': unit}


def _of_housing(found: float, found_sigma: float, sigma: float, misalignment: float) -> float:
    """Return the sigma of an angle relative to the housing, from that to the sensor axes."""
    # the angle between them is one of two axis errors of equal size whose sum is ``found``
    if not misalignment:
        return sigma
    posterior_share = min(1.0, found_sigma**2 / (2 * misalignment**2))
    out: float = np.sqrt(sigma**2 + misalignment**2 * (1 + posterior_share) / 2 + (found / 2)**2)
    return out


def level_pitch(fit: Fit, near: JointMarginals, widen: float) -> dict[str, Any]:
    """Return the pitch relative to the accelerometer's level: third pitch of method_real."""
    k = len(near) // 2
    n = fit.solved.step.shape[1]
    at = np.array([2 * n + layout.PITCH, layout.BA.start])
    C = near[k][np.ix_(at, at)]
    row = np.array([1.0, -1 / G])
    return {'value': float(row @ [fit.state.constants[layout.PITCH], fit.state.accel_bias[k, 0]]),
            'sigma': float(np.sqrt(row @ C @ row) * widen), 'unit': 'rad'}


def wheels_in_map(problem: Problem, c: Floats, sigma: Floats) -> float:
    """Return the sigma of ln K by positions in a local frame that contain the wheels."""
    if not problem.leg.origin.local or not follows_odometer(c[layout.FIX_BY_MOTION],
                                                            sigma[layout.FIX_BY_MOTION]):
        return 0.0
    return by_map_drift(c[layout.FIX_BY_MOTION], c[layout.FIX_TIME],
                        problem.leg.t_stop - problem.leg.t_begin)


def beyond_fit(problem: Problem, fit: Fit, sigma: Floats) -> list[tuple[int, str, float]]:
    """Return errors beside those of the fit: the index of a constant, a source and its sigma."""
    by_map = wheels_in_map(problem, fit.state.constants, sigma)
    leg = problem.leg
    by_height = 0.0 if leg.origin.local or not np.isnan(leg.fixes_n[:, 2]).all() \
        else HEIGHT_UNKNOWN / A
    # which of the two values a later drive has is unknown
    moved = [(step.constant, 'change_of_mounting', abs(step.size)) for step in fit.steps
             if step.constant != layout.LN_K and step.certain]
    of_scale = [(layout.LN_K, name, own) for name, own in (
        ('wheels_in_positions', by_map), ('height', by_height)) if own]
    return of_scale + moved


def remarks(problem: Problem, fit: Fit, sigma: Floats, ratio: Floats,
            config: Config) -> list[Reason]:
    """Return reasons; sigma : (M,) of the constants; ratio : (M,) posterior to prior sigma."""
    c = fit.state.constants
    said = [*_noisy(problem, fit.levels), *_outlying(fit),
            *lag_reasons(c[layout.FIX_LAG2], sigma[layout.FIX_LAG2]),
            *odometer_reasons(c[layout.FIX_BY_MOTION], sigma[layout.FIX_BY_MOTION],
                              c[layout.FIX_TIME], wheels_in_map(problem, c, sigma)),
            *(reason for name, i in CLOCKS.items()
              for reason in clock_reasons(name, c[i], sigma[i], float(np.ptp(fit.state.t)))),
            *_varies(fit, sigma), *_changes(fit), *_bias_steps(fit)]
    usual = imperfect_sigmas(grade_of(config.imu))
    off = np.zeros(len(c))
    off[layout.IMPERFECT] = np.abs(c[layout.IMPERFECT]) / np.maximum(usual, 1e-300)
    off *= np.abs(c) > REMARK_SIGMAS * sigma
    skew = float(np.linalg.norm(off[AXES]))
    if skew > ANOTHER_IMU:
        seen = np.rad2deg(np.linalg.norm(c[AXES][off[AXES] > 0]))
        said.append(Reason(Code.IMU_AXES_SKEW, 'accelerometer axes are '
                           f'{seen:.2f} deg off perpendicular, '
                           f'{skew:.0f} times the sigma of the {config.imu.grade} grade '
                           f'(limit {ANOTHER_IMU:g}); accounted for'))
    worst = max(IMU_SCALES, key=lambda i: off[i])
    if off[worst] > ANOTHER_IMU:
        name = layout.CONSTANTS[worst].replace('_', ' ')
        said.append(Reason(Code.IMU_WORSE_THAN_GRADE, f'the {name} '
                           f'is {100 * c[worst]:+z.1f} % off, {off[worst]:.0f} times the sigma of '
                           f'the {config.imu.grade} grade (limit {ANOTHER_IMU:g}); '
                           'accounted for'))
    return said + _arms(c, sigma, ratio, config)


def _noisy(problem: Problem, levels: Levels) -> list[Reason]:
    """Return the reason for fix errors, white and correlated, above the stated ones."""
    slow = levels['slow'] * levels.correlation_time / 2 if levels.correlation_time else 0.0
    factor = np.sqrt(levels['fix'] + slow / problem.fix_sigma**2)
    if factor <= FIX_NOISE_LIMIT:
        return []
    return [Reason(Code.FIXES_NOISIER_THAN_SAID, 'fix errors (white and time-correlated) are '
                   f'{factor:.1f} times as large as their covariance states (limit '
                   f'{FIX_NOISE_LIMIT:g})',
                   OF_POSES if problem.leg.origin.local else '')]


def _outlying(fit: Fit) -> list[Reason]:
    """Return the reason for fixes that are outliers."""
    fixes = fit.weighted[Fixes]
    outlier = fixes.weight[:, 0] < 0.5
    count, of = int(outlier.sum()), len(outlier)
    if count < max(FEWEST_OUTLYING, OUTLIER_SHARE * of):
        return []
    far = np.hypot(*fixes.raw[outlier, :2].T).max()
    return [Reason(Code.FIX_OUTLIERS, f'{count} of {of} fixes ({100 * count / of:.0f} %) are '
                   f'outliers, up to {far:.1f} m from the track; they were down-weighted')]


def _varies(fit: Fit, sigma: Floats) -> list[Reason]:
    """Return the reason for a scale that varies in the leg."""
    motion, c = fit.weighted[MotionRows].motion, fit.state.constants
    said = []
    for i, span, what in ((layout.BY_SPEED, motion.from_mean[:, 0], 'from low to high speed'),
                          (layout.BY_TIME, motion.from_mean[:, 1], 'from start to end')):
        change, doubt = np.array([c[i], sigma[i]]) * np.ptp(span)
        if abs(change) > max(REMARK_SIGMAS * doubt, LEAST_CHANGE):
            said.append(f'{100 * change:+z.2f} ± {100 * doubt:.2f} % {what}')
    if not said:
        return []
    less = said[0].startswith('-') and 'speed' in said[0]
    return [Reason(Code.SCALE_VARIES, f'the scale changes by {" and ".join(said)}; the stated '
                   'value is the mean over this leg', FALLS_WITH_SPEED if less else '')]


def _bias_steps(fit: Fit) -> list[Reason]:
    """Return the reason for a bias that steps: the largest step of each sensor."""
    said = []
    for name, bias, column, unit, per in (
            ('gyro', fit.state.gyro_bias, GYRO_STEP, 'deg/s', np.rad2deg(1.0)),
            ('accelerometer', fit.state.accel_bias, ACCEL_STEP, 'm/s^2', 1.0)):
        odd = np.r_[False, fit.spread[:, column] > STEP_VARIANCE, False]
        begin, end = np.flatnonzero(np.diff(odd.astype(int))).reshape(-1, 2).T
        size = np.linalg.norm(bias[end] - bias[begin], axis=1)
        if len(size):
            k = int(np.argmax(size))
            said.append(f'the {name} bias changes by {per * size[k]:.2g} {unit} near '
                        f't = {fit.state.t[begin[k]]:.0f} s')
    return [Reason(Code.IMU_BIAS_STEP, '; '.join(said) + '; estimated before and after')
            ] if said else []


def _changes(fit: Fit) -> list[Reason]:
    """Return the reason for a scale or mounting that changes in the leg."""
    said = []
    for step in fit.steps:
        if step.certain and abs(step.size) > LEAST_CHANGE:
            what = layout.CONSTANTS[step.constant].replace('_', ' ')
            size = f'{100 * step.size:+z.2f} %' if step.constant == layout.LN_K else \
                f'{np.rad2deg(step.size):+z.2f} deg'
            said.append(f'the {what} changes by about {size} near t = {step.t:.0f} s '
                        f'({abs(step.size) / step.sigma:.0f} sigma)')
    return [Reason(Code.CHANGE_IN_LEG, '; '.join(said))] if said else []


def arms_off(c: Floats, sigma: Floats) -> set[int]:
    """Return the axes of lever arms that the drive puts far from their setting, by index."""
    axes = (*range(layout.ODO_ARM.start, layout.ODO_ARM.stop - 1),      # not z of the odometer
            *range(layout.GNSS_ARM.start, layout.GNSS_ARM.stop))
    worth = 0.3     # m
    return {i for i in axes if abs(c[i]) > max(REMARK_SIGMAS * sigma[i], worth)}


def _arms(c: Floats, sigma: Floats, ratio: Floats, config: Config) -> list[Reason]:
    """Return LEVER_ARM_OFF for the lever arms that the drive puts far from their setting."""
    said, do = [], []
    off = arms_off(c, sigma)
    for name, arm, where in (('odometer.lever_arm', config.odometer.lever_arm, layout.ODO_ARM),
                             ('gnss.lever_arm', config.gnss.lever_arm, layout.GNSS_ARM)):
        for i, axis, value, most in zip(range(where.start, where.stop), 'xyz', arm, VEHICLE,
                                        strict=True):
            if i not in off:
                continue
            found = value + c[i]
            text = f'{found:+z.2f} ± {sigma[i]:.2f} m'
            # not among the estimates
            rough = ' (too uncertain for a result)' * bool(ratio[i] >= INFORMED_SHARE)
            if abs(found) > most:
                said.append(f'{name} {axis}: {text} is larger than a vehicle, so not plausible')
                do.append(f'Ignore the estimate of {name} {axis}: another error causes it.')
            elif any(arm):
                said.append(f'{name} {axis}: set to {value:+z.2f} m, estimated {text}{rough}')
                do.append(f'Measure {name} {axis} again.')
            else:
                said.append(f'{name} {axis}: not set, estimated {text}{rough}')
                do.append(f'Measure {name} {axis} and set it.')
    return [Reason(Code.LEVER_ARM_OFF, f'{"; ".join(said)}; accounted for', ' '.join(
        [*do, SLIDES] if any('easure' in x for x in do) else do))] if said else []
