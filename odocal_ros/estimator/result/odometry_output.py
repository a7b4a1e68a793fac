# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Data of a fitted leg for other programs, beside the calibrated values.

``odometry_details`` describes odometer messages and motion, ``raw_scale`` is the scale factor of a
quantised speed for programs that only multiply, ``TwistNoise`` the covariance of the twist (speed
and turn rate) that calibrated wheels give.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from odocal_ros.calib.result import Calibration, Estimate, MethodResult, RAW_SCALE
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.axle import WALK_SPEED
from odocal_ros.estimator.factors.interval_noise import accelerating_and_turning, TURNING_RATE
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BA, FAST_SPEED, LN_K, SPEED_OFFSET, State
from odocal_ros.settings.config import SIDES
from odocal_ros.settings.nominal import G, Grade

AXIS_XY, AXIS_ZX = map(layout.CONSTANTS.index, ('accelerometer_axis_xy', 'accelerometer_axis_zx'))
SWAY_TIME = 0.1      # s, judgement: a body does not change its sideways velocity faster


def odometry_details(leg: SmootherLeg, problem: Problem, fit: Fit, marginals: JointMarginals,
                     factor: float) -> dict[str, Any]:
    """
    Return ``odometer`` and ``accelerometer_bias``, as details of a method.

    odometer: sigma of a reading in scale units, period s, step of a quantised speed in scale units
    per s, share of the motion with acceleration, speeds m/s and turn rates rad/s in motion.
    Biases at the start of the leg in b, m/s^2. factor : on the sigmas of the fit.
    """
    motion = fit.weighted[MotionRows].motion
    moving = ~problem.at_rest[:-1] & ~problem.at_rest[1:]
    moving = moving if moving.any() else ~moving
    speed = (np.linalg.norm(motion.displacement, axis=1) / motion.T[:, 0])[moving]
    rate = motion.turning[moving]
    t, coarse = leg.travel.t, leg.travel.coarse
    within = (t >= leg.t_begin) & (t <= leg.t_stop)
    # the lower limit of the level, which a reading without quantisation has, is no error
    no_error = 0.0 if leg.travel.quantum else problem.min_levels['travel']
    odometer = {
        'reading': float(np.sqrt(max(fit.levels['travel'] - no_error, 0.0))),
        'period': float(np.median(np.diff(t[within]))),
        'speed_step': coarse.step if coarse else 0.0,
        'hard': float(accelerating_and_turning(motion)[0][moving].mean()),
        'speed': float(np.sqrt(np.mean(speed**2))), 'fastest': float(speed.max()),
        'turn_rate': float(np.sqrt(np.mean(rate**2))), 'fastest_turn': float(rate.max()),
        'square_speed': float(speed @ speed**2 / speed.sum()) if speed.any() else 0.0}
    sigma = np.sqrt(np.diagonal(marginals[0])[BA]) * factor
    ratio = sigma / fit.initial_priors.accel_bias_sigma
    biases = zip('xyz', fit.state.accel_bias[0], sigma, ratio, strict=True)
    return {'odometer': odometer} | ({'accelerometer_bias': {
        axis: {'value': float(value), 'sigma': float(s), 'ratio': float(ratio)}
        for axis, value, s, ratio in biases}} if leg.has_accelerometer else {})


def raw_scale(leg: SmootherLeg, state: State, covariance: Floats) -> dict[str, Estimate]:
    """
    Return the path length over the integral of the raw speeds, by name; {} without steps.

    It differs from K, since a truncated speed lacks half a step while the vehicle moves:
    K (1 + offset t / s), with t the time in motion and s the integral.

    covariance : (M, M) of the constants.
    """
    coarse = leg.travel.coarse
    if coarse is None or not leg.uses_speed_steps:
        return {}
    middle = (coarse.t[1:] + coarse.t[:-1]) / 2
    within = (middle >= leg.t_begin) & (middle <= leg.t_stop)
    dt, speed = np.diff(coarse.t)[within], np.abs(coarse.value[1:])[within]
    if not speed.any():
        return {}
    by_offset = float(dt[speed > 0].sum() / (dt @ speed))       # t / s
    ratio = 1 + by_offset * state.constants[SPEED_OFFSET]
    gradient, rows = np.array([1.0, by_offset / ratio]), [LN_K, SPEED_OFFSET]
    relative = float(np.sqrt(gradient @ covariance[np.ix_(rows, rows)] @ gradient))
    value = state.scale * ratio
    return {RAW_SCALE: Estimate(value, value * relative, leg.scale_unit)}


def combine_raw_scales(legs: Sequence[MethodResult], scale: Estimate) -> dict[str, Estimate]:
    """Return ``raw_scale`` of several legs: joint scale times mean ratio to the scale."""
    ratios = [(e[RAW_SCALE].value or 0.0) / (e['scale_factor'].value or 1.0)
              for e in (leg.estimates for leg in legs) if RAW_SCALE in e]
    if not ratios or scale.value is None or scale.sigma is None:
        return {}
    ratio = float(np.mean(ratios))
    sigma = float(np.hypot(scale.sigma, scale.value * np.std(ratios) / np.sqrt(len(ratios))))
    return {RAW_SCALE: Estimate(scale.value * ratio, sigma * ratio, scale.unit)}


def additional_figures(value: Floats, covariance: Floats, grade: Grade | None) -> dict[str, Any]:
    """Return further figures for calibration.json; grade : of the IMU, None: no accelerometer."""
    sigma = np.sqrt(np.diag(covariance))
    # scale_by_speed: the slope at FAST_SPEED
    out: dict[str, Any] = {
        layout.CONSTANTS[i]: {'slope': float(value[i]), 'sigma': float(sigma[i]), 'unit': unit}
        for i, unit in ((layout.SCALE_BY_SPEED, '1/(m/s)'), (layout.SCALE_BY_TIME, '1/s'),
                        (layout.SCALE_BY_LEFT_FORCE, '1/(m/s^2)'),
                        (layout.SCALE_BY_CURVATURE, 'm^2'))}
    if grade is not None:
        for name, angle, axis in (('yaw', layout.YAW, AXIS_XY), ('pitch', layout.PITCH, AXIS_ZX)):
            out[f'{name}_mounting_angle_housing_sigma'] = {'value': _housing_sigma(
                value[axis], float(sigma[axis]), float(sigma[angle]), grade.misalignment_sigma),
                'sigma': None, 'unit': 'rad'}
    next_drive = 1e-3       # physical: 1 sigma of the scale between drives, tyres warm or cold
    return out | {'scale_ratio_next_drive_sigma': {
        'value': float(np.hypot(sigma[layout.LN_K], next_drive)), 'sigma': None, 'unit': '1'}}


def _housing_sigma(error: float, error_sigma: float, sigma: float, misalignment: float) -> float:
    """Return the sigma of a mounting angle of the IMU housing, from that of its sensor axes."""
    # two axis errors with the same prior have the sum ``error``; one of them is the difference
    if not misalignment:
        return sigma
    posterior_share = min(1.0, error_sigma**2 / (2 * misalignment**2))
    return float(np.sqrt(sigma**2 + misalignment**2 * (1 + posterior_share) / 2 + (error / 2)**2))


def level_pitch(fit: Fit, marginals: JointMarginals, factor: float) -> dict[str, Any]:
    """Return the pitch mounting relative to the level of the accelerometer with its bias."""
    k, n = len(marginals) // 2, fit.solution.step.shape[1]
    rows = np.array([2 * n + layout.PITCH, layout.BA.start])
    C = marginals[k][np.ix_(rows, rows)]
    gradient = np.array([1.0, -1 / G])
    return {'value': float(gradient @ [fit.state.constants[layout.PITCH],
                                       fit.state.accel_bias[k, 0]]),
            'sigma': float(np.sqrt(gradient @ C @ gradient) * factor), 'unit': 'rad'}


@dataclass(frozen=True, eq=False)
class TwistNoise:
    """Errors of the twist (speed and turn rate) that calibrated wheels give for each message."""

    period: float                     # s, between messages
    speed: float                      # m/s, rms in motion
    turn_rate: float                  # rad/s, rms in motion
    fastest: tuple[float, float]      # highest speed, m/s, and turn rate, rad/s
    legs: tuple[dict[str, Any], ...]  # details of the fit of each leg
    estimates: dict[str, Estimate]    # of the calibration

    @property
    def has_turn_rate(self) -> bool:
        """Return True if two wheels give the turn rate."""
        return all(f'scale_factor_{side}' in self.estimates for side in SIDES) and bool(
            self._estimate('track_width')[0]) and all(
                'left' in leg['wheels'] for leg in self.legs)

    def variances(self, speed: float, turn_rate: float) -> Floats:
        """
        Return the variances of the velocity forward, left and up and of the turn rate: (4,).

        In (m/s)^2 and (rad/s)^2, mean of the legs; the turn rate is NaN if it is not measured.
        speed, turn_rate : m/s, rad/s.
        """
        mean: Floats = np.mean([self._leg_variances(leg, abs(speed), abs(turn_rate))
                                for leg in self.legs], axis=0)
        return mean

    def _leg_variances(self, leg: dict[str, Any], v: float, w: float) -> Floats:
        """Return ``variances`` from one leg; v, w : m/s, rad/s, speed and turn rate, absolute."""
        noise, odometer, T = leg['noise'], leg['odometer'], self.period
        K = self._estimate('scale_factor')[0]
        factor = self._estimate(RAW_SCALE)[0] or K
        # as in interval_noise.py: noise is proportional to the time, below 1 m/s to the path
        per_level = min(max(v, 0.02), 1.0) / T      # 1/s, variance of a mean speed over its level
        accelerating = odometer['hard']             # share of the time
        reading = (K * odometer['reading'])**2 / T**2       # of one reading; an interval has two
        along = (1 - accelerating) * noise['along']**2 + accelerating * noise['along_hard']**2
        sway_per_level = per_level * T / max(T, SWAY_TIME)
        steps = noise.get('steps')
        if steps is not None:     # the fit does not use the integral of such a speed
            along, reading = 0.0, 0.0
        side = noise['side_turn' if w > TURNING_RATE else 'side']**2
        white = leg['widened']**2 * np.array(
            [along * per_level + 2 * reading, side * sway_per_level,
             noise['up']**2 * sway_per_level])
        arm_x, arm_y = (np.square(self._estimate(f'odometer_lever_arm_{axis}')).sum()
                        for axis in 'xy')
        by_sideslip = _mean_square(leg['sideslip']) * (v**2 * w)**2
        constant = np.array([self._scale_variance(leg, v, w) + arm_y * w**2,
                             by_sideslip + arm_x * w**2, 0.0])
        coarse = (K * odometer['speed_step'])**2 / 12 * max(steps or 1.0, 1.0)**2 + (
            (factor - K) / K * v - K * leg['speed_offset']['value'])**2 * (factor != K)
        return np.append(white + constant + [coarse, 0.0, 0.0],
                         self._turn_rate(leg, v, w, per_level, reading))

    def _scale_variance(self, leg: dict[str, Any], v: float, w: float) -> float:
        """Return the variance of the speed from the scale: its sigma, its change from the mean."""
        scale, sigma = self._estimate('scale_factor')
        by_speed, by_curvature = (_mean_square(leg[f'scale_by_{signal}'])
                                  for signal in ('speed', 'curvature'))
        square = (v**2 - leg['odometer']['square_speed']) / (2 * FAST_SPEED)
        curvature = w**2 / (2 * max(v**2, WALK_SPEED**2))
        return float(v**2 * ((sigma / scale)**2 + by_speed * square**2
                             + by_curvature * curvature**2))

    def _turn_rate(self, leg: dict[str, Any], v: float, w: float, per_level: float,
                   reading: float) -> float:
        """Return the variance of the turn rate from the difference of two wheels."""
        if not self.has_turn_rate:
            return np.nan
        left, right = (leg['wheels'][side] for side in SIDES)
        (width, sigma), share = self._estimate('track_width'), leg['odometer']['hard']
        constant, accelerating, turning = (np.square(left['walk']) + np.square(right['walk'])) / 2
        walk = turning if w > TURNING_RATE else (1 - share) * constant + share * accelerating
        # the mean of two wheels has half the variance of one; their deviations from the mean have
        # opposite signs
        white = leg['widened']**2 * (4 * walk * per_level + 8 * reading)
        ratio = left['ratio_sigma'] + right['ratio_sigma']
        return float(white + (sigma * w)**2 + (ratio * v)**2) / width**2

    def _estimate(self, name: str) -> tuple[float, float]:
        """Return value and sigma of an estimate, 0 if it is not determined."""
        estimate = self.estimates.get(name)
        return (estimate.value or 0.0, estimate.sigma or 0.0) if estimate else (0.0, 0.0)


def twist_noise(calibration: Calibration) -> TwistNoise | None:
    """Return the errors of the twist, None without a scale factor of the smoother."""
    scale = calibration.estimates.get('scale_factor')
    fitted = [leg.methods['smoother'].details for leg in calibration.legs
              if 'smoother' in leg.methods and leg.verdict.value != 'rejected']
    legs = tuple({'wheels': {}, **details} for details in fitted if 'odometer' in details)
    if scale is None or not scale.value or scale.method != 'smoother' or not legs:
        return None
    odometers = [leg['odometer'] for leg in legs]
    speed, turn_rate = (float(np.sqrt(np.mean(np.square([o[name] for o in odometers]))))
                        for name in ('speed', 'turn_rate'))
    return TwistNoise(float(np.median([o['period'] for o in odometers])), speed, turn_rate,
                      (max(o['fastest'] for o in odometers),
                       max(o['fastest_turn'] for o in odometers)), legs, calibration.estimates)


def _mean_square(effect: dict[str, float]) -> float:
    """Return the mean square of an effect, value and sigma, that a driver does not correct."""
    return effect['value']**2 + effect['sigma']**2
