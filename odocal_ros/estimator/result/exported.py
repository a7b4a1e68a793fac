# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Facts of a fitted leg that the exported noises need: odometer messages, motion, biases."""

from typing import Any

import numpy as np

from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.interval_noise import hard_and_turning
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BA


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
    rate = np.abs(np.einsum('ki,ki->k', motion.C[:, 2], motion.sums.mean_rate))[moving]
    t, coarse = leg.travel.t, leg.travel.coarse
    within = (t >= leg.t_begin) & (t <= leg.t_stop)
    odometer = {
        'reading': _reading_sigma(leg, problem, fit),
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


def _reading_sigma(leg: SmootherLeg, problem: Problem, fit: Fit) -> float:
    """Return the sigma of a reading of the odometer, 0 if the fit has only its lower limit."""
    level = fit.levels['travel']
    limit = 0.0 if leg.travel.quantum else problem.least['travel']
    return float(np.sqrt(max(level - limit, 0.0)))
