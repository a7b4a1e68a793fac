# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The mean factor of a quantised speed as published: for consumers that only multiply."""

from collections.abc import Sequence

import numpy as np

from odocal_ros.calib.result import AS_SENT, Estimate, MethodResult
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.state import LN_K, SPEED_OFFSET, State


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
