# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Facts of a fitted leg for files of other programs: odometer messages, motion, biases.

The mean factor of a quantised speed as published is for consumers that only multiply.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from odocal_ros.calib.result import AS_SENT, Estimate, MethodResult
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.interval_noise import hard_and_turning
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BA, LN_K, SPEED_OFFSET, State


def exported(leg: SmootherLeg, problem: Problem, fit: Fit, near: JointMarginals,
             widen: float) -> dict[str, Any]:
    """
    Return ``odometer`` and ``accelerometer_bias``, as details of a method.

    odometer: sigma of a reading in scale units, period s, step of a quantised speed in scale units
    per s, share of the motion that is accelerated, speeds m/s and turn rates rad/s in motion.
    Biases at the start of the leg in b, m/s^2, with the ratio of their sigmas to the prior's.
    """
    motion = fit.weighted[MotionRows].motion
    path = np.linalg.norm(motion.displacement, axis=1)
    moving = ~problem.still[:-1] & ~problem.still[1:]
    moving = moving if moving.any() else ~moving
    speed = (path / motion.T[:, 0])[moving]
    rate = motion.turning[moving]
    t, coarse = leg.travel.t, leg.travel.coarse
    within = (t >= leg.t_begin) & (t <= leg.t_stop)
    least = 0.0 if leg.travel.quantum else problem.least['travel']      # no reading error
    odometer = {
        'reading': float(np.sqrt(max(fit.levels['travel'] - least, 0.0))),
        'period': float(np.median(np.diff(t[within]))),
        'speed_step': coarse.step if coarse else 0.0,
        'hard': float(hard_and_turning(motion)[0][moving].mean()),
        'speed': float(np.sqrt(np.mean(speed**2))), 'fastest': float(speed.max()),
        'turn_rate': float(np.sqrt(np.mean(rate**2))), 'fastest_turn': float(rate.max()),
        'square_speed': float(speed @ speed**2 / speed.sum()) if speed.any() else 0.0}
    sigma = np.sqrt(np.diagonal(near[0])[BA]) * widen
    biases = zip('xyz', fit.state.accel_bias[0], sigma, sigma / fit.first.accel_bias, strict=True)
    return {'odometer': odometer} | ({'accelerometer_bias': {
        axis: {'value': float(value), 'sigma': float(s), 'ratio': float(ratio)}
        for axis, value, s, ratio in biases}} if leg.has_accelerometer else {})


def as_sent(leg: SmootherLeg, state: State, covariance: Floats) -> dict[str, Estimate]:
    """
    Return the path length of a leg over the integral of its speeds as sent, by its name.

    A truncated speed lacks half a step while the vehicle moves: K (1 + offset t / s), with t the
    time in motion and s the integral. Only of a speed that the smoother uses by its steps.

    leg, state : SmootherLeg, State.   covariance : (M, M) of the constants.
    """
    coarse = leg.travel.coarse
    if coarse is None or not leg.by_steps:
        return {}
    middle = (coarse.t[1:] + coarse.t[:-1]) / 2
    within = (middle >= leg.t_begin) & (middle <= leg.t_stop)
    dt, speed = np.diff(coarse.t)[within], np.abs(coarse.value[1:])[within]
    if not speed.any():
        return {}
    lacks = float(dt[speed > 0].sum() / (dt @ speed))       # of the scale, by the offset
    whole = 1 + lacks * state.constants[SPEED_OFFSET]
    by = np.array([1.0, lacks / whole])
    at = [LN_K, SPEED_OFFSET]
    relative = float(np.sqrt(by @ covariance[np.ix_(at, at)] @ by))
    value = state.scale * whole
    return {AS_SENT: Estimate(value, value * relative, leg.scale_unit)}


def as_sent_of(legs: Sequence[MethodResult], scale: Estimate) -> dict[str, Estimate]:
    """Return the factor of several legs: joint scale times mean ratio of factor and scale."""
    ratios = [(leg.estimates[AS_SENT].value or 0.0) / (leg.estimates['scale_factor'].value or 1.0)
              for leg in legs if AS_SENT in leg.estimates]
    if not ratios or scale.value is None or scale.sigma is None:
        return {}
    ratio = float(np.mean(ratios))
    sigma = float(np.hypot(scale.sigma, scale.value * np.std(ratios) / np.sqrt(len(ratios))))
    return {AS_SENT: Estimate(scale.value * ratio, sigma * ratio, scale.unit)}
