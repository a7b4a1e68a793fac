# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Faults of gyro axes, by the accelerometer and by the course of the fixes.

The ratio of turns by the gyro to turns of the course shows a wrong sign or unit. The rotation of
gravity in the IMU shows gyro axes with a wrong sign or swapped: imu.mounting_rpy cannot correct
these, because it rotates gyro and accelerometer together. If the first level axis of the
accelerometer has the wrong sign, the second level axis and the upright axis of the gyro appear to
have the wrong sign: turn rates in mirrored axes have these signs.
"""

from typing import NamedTuple

import numpy as np

from odocal_ros.calib.drive import separated_fixes
from odocal_ros.calib.reversals import PLAUSIBLE_RATIO
from odocal_ros.data.arrays import Floats, Ints, map_rows
from odocal_ros.nav.geodesy import MIN_GNSS_MOTION
from odocal_ros.nav.rotations import arctan2
from odocal_ros.nav.time_series import double_integral_at, gaps_longer, integral_at
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.gravity_fit import gravity_fit
from odocal_ros.screening.imu_orientation import ImuOrientation
from odocal_ros.screening.inputs import Inputs, LocatedFixes
from odocal_ros.settings.levels import RAD_PER_DEG

# definition: coefficients of ``gravity_fit`` for correct e1, e2 and up axes of the gyro; and those
# of an axis that is mirrored (negative) or measures the rotation about e1 (real) or e2 (imaginary)
CORRECT_COEFFICIENTS = np.array([1.0, 1j, 0.0])
WRONG_COEFFICIENTS = np.array([1.0, -1.0, 1j, -1j])
# statistical: largest chance of a correct axis, and distance from a wrong one; both must hold.
# False alarms in 0 of 384 zoo drives (lowest chance 1.9e-4); zoo.md
MAX_CHANCE, MAX_DEVIATION = 5e-5, 0.4
# the ratio ``ImuOrientation.centripetal``, 1 if correct: statistical, sigmas of a certain sign;
# judgement, limit below which it is inverted (a vehicle that leans into its turns has 0)
SIGN_SIGMAS, INVERTED_RATIO = 5.0, -0.5
# statistical: least correlation of the turns by gyro and by course, and least sigmas of their
# ratio, since a few courses may be correlated by chance
MIN_CORRELATION, SLOPE_SIGMAS = 0.9, 8.0
LONGEST_GAP = 1.0      # s, judgement: of the IMU, turns within a longer one are not measured
# rad^2, judgement: a chord with a U-turn in it, and the next, are off by 0.35 rad each (0.1 to 0.2
# for a mower whose rows are 1.6 m apart)
U_TURN_ERROR = 0.25
NO_ROTATION = 'imu.mounting_rpy cannot correct this: it rotates gyro and accelerometer together.'


class WrongAxis(NamedTuple):
    """A gyro axis that is published under another name or with the wrong sign."""

    published: str    # such as 'x'
    true: str         # with its sign, such as '-y'
    text: str         # what was observed, for the reason


def level_axes(up: Floats) -> tuple[Floats, list[str]]:
    """Return level e1, e2 and up as rows, (3, 3), and the nearest sensor axes, such as "-y"."""
    upright = int(np.argmax(np.abs(up)))
    first, second = (upright + 1) % 3, (upright + 2) % 3
    e1 = np.eye(3)[first] - up[first] * up
    e1 /= np.linalg.norm(e1)
    sign = '-' * bool(up[upright] < 0)
    names = ['xyz'[first], sign + 'xyz'[second], sign + 'xyz'[upright]]
    return np.stack([e1, np.cross(up, e1), up]), names


def check_turns(inputs: Inputs, located: LocatedFixes, orientation: ImuOrientation | None,
                gyro_scale: float) -> tuple[float | None, tuple[Reason, ...]]:
    """Return the ratio of turns by gyro to those by fixes, None if unknown, and reasons."""
    ratio = turn_ratio(inputs.t_imu, map_rows(lambda w_b: w_b @ inputs.up_b, inputs.w_b),
                       inputs.t_fix, located.fixes_n, located.fix_sigma, inputs.min_motion)
    reasons = gyro_reasons(ratio, gyro_scale)
    if not any(reason.code is Code.GYRO_SIGN for reason in reasons):
        axis_reasons = wrong_axis_reasons(inputs, located, orientation)
        return ratio, axis_reasons if axis_reasons else reasons
    text, remedy = reasons[0].text, '' if inputs.has_accelerometer else (
        'Set imu.mounting_rpy, or correct the sign in the IMU driver.')
    if orientation and abs(orientation.centripetal) > max(
            -INVERTED_RATIO, SIGN_SIGMAS * orientation.centripetal_sigma):
        if orientation.centripetal < 0:
            text += ', and to the accelerations in turns: angular_velocity has the wrong sign'
        else:
            text += (', but match the accelerations in turns: latitude and longitude (x and y) '
                     'are swapped, or linear_acceleration is negated')
            remedy = ('Swap latitude and longitude in the driver of the fixes if a map shows the '
                      'track mirrored; if not, negate linear_acceleration in the IMU driver. '
                      f'{NO_ROTATION}')
    return ratio, (Reason(Code.GYRO_SIGN, text, remedy),)


def wrong_axis_reasons(inputs: Inputs, located: LocatedFixes,
                       orientation: ImuOrientation | None) -> tuple[Reason, ...]:
    """
    Return a reason if an axis of gyro or accelerometer is mirrored, or two of the gyro swapped.

    located : the fixes in metres and approximate scale.   orientation : from the accelerations.
    A flat road does not show roll and pitch, a straight one no yaw.
    """
    w_i, f_i = (map_rows(lambda x: x @ inputs.C_bi, x) for x in (inputs.w_b, inputs.f_b))
    up = inputs.median_f_b @ inputs.C_bi
    axes, names = level_axes(up / np.linalg.norm(up))
    wrong_axes = wrong_axes_by_course(inputs, located, w_i, axes, names)
    if not wrong_axes and inputs.has_accelerometer:
        is_inverted = orientation and orientation.centripetal < min(
            INVERTED_RATIO, -SIGN_SIGMAS * orientation.centripetal_sigma)
        if is_inverted:     # invert the yaw rate: then it matches the accelerometer
            w_i = w_i - 2 * np.outer(w_i @ axes[2], axes[2])
        wrong_axes = wrong_axes_by_gravity(inputs, located, w_i, f_i, axes, names)
        if orientation and is_inverted:
            return _inverted_turns(orientation, wrong_axes, names)
    if not wrong_axes:
        return ()
    text = '; '.join(axis.text for axis in wrong_axes)
    if not inputs.has_accelerometer and len(wrong_axes) == 1:
        return (Reason(Code.GYRO_AXES, text, _upright_remedy(wrong_axes[0], names[2])),)
    action = '; '.join(
        f'negate angular_velocity.{published}' if published == true[-1] else
        f'publish the value of angular_velocity.{published}{", negated," * (true[0] == "-")} as '
        f'angular_velocity.{true[-1]}' for published, true, _ in wrong_axes)
    if len(wrong_axes) == 1 and wrong_axes[0].published != wrong_axes[0].true[-1]:
        action += '; then check the other axes'
    return (Reason(Code.GYRO_AXES, text,
                   f'Correct the IMU driver: {action}. {NO_ROTATION}'),)


def _upright_remedy(axis: WrongAxis, up: str) -> str:
    """Return the action for a gyro without accelerometer whose upright axis is not z."""
    minus = axis.true.startswith('-') ^ up.startswith('-')
    angle = -np.pi / 2 if minus ^ (axis.published == 'x') else np.pi / 2
    rpy = [0, round(angle, 4), 0] if axis.published == 'x' else [round(angle, 4), 0, 0]
    return (f'Set imu.mounting_rpy to {rpy}: {"-" * minus}{axis.published} points up then. If the '
            'IMU is upright, correct the order of the axes in its driver.')


def _inverted_turns(orientation: ImuOrientation, wrong_axes: list[WrongAxis],
                    names: list[str]) -> tuple[Reason, ...]:
    """Return the reason for accelerations to the outside of turns."""
    text = ('accelerations in turns are opposite to turn rate and speed (ratio '
            f'{orientation.centripetal:.2f} ± {orientation.centripetal_sigma:.1g}, expected: 1)')
    level_names = [name[-1] for name in names[:2]]
    # a mirrored level axis of the accelerometer makes the other level axis of the gyro look wrong
    mirrored = [axis for axis in level_names
                if len(wrong_axes) == 1 and wrong_axes[0][:2] != (axis, '-' + axis)]
    if len(mirrored) == 1:
        return (Reason(Code.IMU_AXES, f'{text}. Gravity rotates about '
                       f'{wrong_axes[0].published} opposite to the gyro: '
                       f'linear_acceleration.{mirrored[0]} has the wrong sign',
                       f'Correct the IMU driver: negate linear_acceleration.{mirrored[0]}. '
                       + NO_ROTATION),)
    return (Reason(Code.GYRO_SIGN, f'{text}: the sign of angular_velocity.{names[2][-1]}, or of '
                   f'linear_acceleration.{level_names[0]} or {level_names[1]}, is wrong',
                   f'Correct the sign in the IMU driver. {NO_ROTATION}'),)


def wrong_axes_by_course(inputs: Inputs, located: LocatedFixes, w_i: Floats, axes: Floats,
                         names: list[str]) -> list[WrongAxis]:
    """Return the level gyro axes that measure the yaw rate instead of the upright axis."""
    # w_i : (n, 3) rad/s in i.  axes, names : of ``level_axes``
    def yaw_ratio(axis: Floats) -> float | None:
        """Return the turn ratio of an axis, None if it is not that of the yaw rate."""
        ratio = turn_ratio(inputs.t_imu, map_rows(lambda w: w @ axis, w_i), inputs.t_fix,
                           located.fixes_n, located.fix_sigma, inputs.min_motion)
        is_yaw = ratio is not None and PLAUSIBLE_RATIO[0] < abs(ratio) < PLAUSIBLE_RATIO[1]
        return ratio if is_yaw else None
    if yaw_ratio(axes[2]) is not None:
        return []
    wrong_axes = []
    for name, axis in zip(names[:2], axes[:2], strict=True):
        ratio = yaw_ratio(axis)
        if ratio is not None:
            published, true = _published_and_true(name, names[2], ratio)
            wrong_axes.append(WrongAxis(
                published, true, f'angular_velocity.{published} turns with the course of the '
                f'fixes (ratio {ratio:.2f}), angular_velocity.{names[2][-1]} does not'))
    return wrong_axes


def wrong_axes_by_gravity(inputs: Inputs, located: LocatedFixes, w_i: Floats, f_i: Floats,
                          axes: Floats, names: list[str]) -> list[WrongAxis]:
    """Return the gyro axes that measure the rotation of gravity about another axis."""
    # w_i, f_i : (n, 3) rad/s, m/s^2, in i.  axes, names : of ``level_axes``
    fit = gravity_fit(inputs.t_imu, w_i, f_i, axes, inputs.travel, located.rough_scale)
    if fit is None:
        return []
    wrong_axes = []
    distance = np.abs(WRONG_COEFFICIENTS - fit.coefficient[:, None])
    nearest = WRONG_COEFFICIENTS[distance.argmin(axis=1)]
    is_close = np.abs(nearest - fit.coefficient) < MAX_DEVIATION
    about_e1 = nearest.imag == 0      # else about e2
    for k, c in enumerate(fit.coefficient):
        # two gyro axes that measure one axis are no mirrored or swapped ones
        if (nearest[k] == CORRECT_COEFFICIENTS[k] or not is_close[k]
                or (is_close & (about_e1 == about_e1[k])).sum() > 1
                or fit.chance(k, CORRECT_COEFFICIENTS[k]) > MAX_CHANCE):
            continue
        measured, coefficient = (names[0], c.real) if about_e1[k] else (names[1], c.imag)
        published, true = _published_and_true(names[k], measured, float(coefficient))
        wrong_axes.append(WrongAxis(
            published, true, f'angular_velocity.{published} measures the rotation of gravity '
            f'about {true} (coefficient {abs(coefficient):.2f} ± {fit.sigma[k]:.2f})'))
    return wrong_axes


def _published_and_true(published: str, measured: str, ratio: float) -> tuple[str, str]:
    """Return an axis without its sign, and the measured axis with the sign relative to it."""
    minus = (ratio < 0) ^ published.startswith('-') ^ measured.startswith('-')
    return published[-1], '-' * minus + measured[-1]


def turn_ratio(t_imu: Floats, w_up: Floats, t_fix: Floats, fixes_n: Floats,
               sigma: float, min_motion: float = MIN_GNSS_MOTION) -> float | None:
    """
    Return turns by the gyro over turns of the course by fixes, None without correlation.

    Mean yaws over chords between fixes are fitted to their courses.

    t_imu, w_up : (n,) s, and turn rate about the upward axis, rad/s.   t_fix, fixes_n : (k,) s,
    (k, 2 or more) m.   sigma : of a fix, horizontally, m.   min_motion : distance between fixes
    that is motion, m.
    """
    inside = (t_fix >= t_imu[0]) & (t_fix <= t_imu[-1])      # turns outside are not measured
    t_fix, fixes_n = t_fix[inside], fixes_n[inside]
    # m: the sigma of a course is then 0.14 rad
    knots = separated_fixes(fixes_n, max(min(5.0, min_motion), 10 * sigma))
    if len(knots) < 5:
        return None
    ends = t_fix[knots]
    gaps = gaps_longer(t_imu, LONGEST_GAP)
    # number of gaps that begin, and that end, before each end of a chord
    begun, ended = (np.searchsorted(edge, ends) for edge in gaps.T)
    # chords in which a vehicle stops and turns: the mean over time is not that over path. Ratio to
    # the median duration, and rad: judgement
    duration = np.diff(ends)
    pivots = (duration > 3.0 * np.median(duration)) & (
        np.abs(np.diff(integral_at(ends, t_imu, w_up))) > 0.5)
    keep = ~pivots & (ended[1:] == begun[:-1]) & (begun[1:] == begun[:-1])
    step = np.diff(fixes_n[knots, :2], axis=0)[keep]
    t = ((ends[:-1] + ends[1:]) / 2)[keep]
    course = np.unwrap(arctan2(step[:, 1], step[:, 0]))
    # the mean angle over each chord; the effect of a bias is linear in time
    gyro = (np.diff(double_integral_at(ends, t_imu, w_up)) / np.diff(ends))[keep]
    # at a sudden U-turn of the course the vehicle may have reversed, and the turn in a gap of the
    # IMU is unknown: a free step of the yaw is fitted there
    restarts = np.flatnonzero((np.abs(np.diff(course)) > 2.0) | (np.diff(ended[1:][keep]) > 0))
    section = np.searchsorted(restarts, np.arange(len(t)))
    course, gyro = (_without_drift(x, t, section) for x in (course, gyro))
    power = float(gyro @ gyro)
    # rad^2: turns of 1 rad in total, root sum of squares, plus the error of chords at U-turns
    if course @ course < 1.0 + U_TURN_ERROR * len(restarts) or power == 0:
        return None
    slope = float(course @ gyro / power)      # of the noisy course on the clean gyro: no bias
    explained = slope**2 * power / (course @ course)      # share of the course's variance
    freedom = len(t) - 3 - len(restarts)      # slope, drift and a constant of each section
    is_certain = explained * freedom > SLOPE_SIGMAS**2 * (1 - explained)
    return 1 / slope if explained > MIN_CORRELATION**2 and is_certain else None


def _without_drift(x: Floats, t: Floats, section: Ints) -> Floats:
    """Return x minus the best constant of each section and a common drift: all (n,)."""
    # not by lstsq: two receivers on one topic have a section for each fix
    count = np.bincount(section)
    x, t = (column - (np.bincount(section, column) / count)[section] for column in (x, t))
    return x - t * (x @ t / max(float(t @ t), 1e-300))


def gyro_reasons(ratio: float | None, gyro_scale: float) -> tuple[Reason, ...]:
    """Return GYRO_SIGN or IMU_UNITS if ``turn_ratio`` shows it; gyro_scale: as configured."""
    if ratio is None or PLAUSIBLE_RATIO[0] < ratio < PLAUSIBLE_RATIO[1]:
        return ()
    if ratio < -PLAUSIBLE_RATIO[0]:
        return (Reason(Code.GYRO_SIGN, 'turns measured by the gyro are opposite to those of '
                       f'the fixes (ratio {ratio:.2f}, expected: 1)'),)
    if abs(ratio) < 0.01:       # no error of the unit: revolutions give 0.16
        return (Reason(Code.IMU_UNITS, f'turns measured by the gyro are only {ratio:#.2g} times '
                       'those of the fixes (expected: 1)', 'Set imu.mounting_rpy if another IMU '
                       'axis is vertical; otherwise correct the IMU driver.'),)
    text = (f'turns measured by the gyro are {ratio:#.3g} times those of the fixes (limits '
            f'{PLAUSIBLE_RATIO[0]:g} and {PLAUSIBLE_RATIO[1]:g})')
    if 40.0 < ratio < 80.0:     # 180 / pi, with a margin for scale errors and skid
        return (Reason(Code.IMU_UNITS, text + ', typical for deg/s',
                       f'Set imu.gyro_scale to {gyro_scale * RAD_PER_DEG:.10g}, or publish rad/s '
                       '(REP-145).'),)
    return (Reason(Code.IMU_UNITS, text, 'Check unit and range of the gyro. If all its rates are '
                   f'wrong by this factor, set imu.gyro_scale to {gyro_scale / ratio:.4g}.'),)
