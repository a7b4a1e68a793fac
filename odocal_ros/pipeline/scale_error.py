# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of the scale beyond a method's own model, put into its sigmas and budget."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from odocal_ros.calib.judge import judge
from odocal_ros.calib.result import MethodResult, Source, wheel_factors
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.reasons import Code

SCALES = ('scale_factor', 'scale_ratio')


def with_scale_error(method: MethodResult, prepared: PreparedLeg, name: str,
                     relative: Mapping[str, float], shared: bool = False) -> MethodResult:
    """
    Return a method's result with an error in the sigmas of its scales.

    method, prepared : the result, and the leg.   name : of the source.   relative : 1 sigma of
    each of SCALES, relative; of a wheel by default that of the scale factor.   shared : the same
    in every leg of the vehicle.
    """
    relative = dict.fromkeys(wheel_factors(method.estimates),
                             relative['scale_factor']) | dict(relative)
    K = method.estimates['scale_factor'].value
    if not K:
        return method
    effects = np.array([[relative.get(name_, 0.0)] for name_ in method.parameters])
    estimates = {name_: replace(e, sigma=float(np.hypot(e.sigma, relative[name_] * e.value)))
                 if name_ in relative and e.value is not None and e.sigma is not None else e
                 for name_, e in method.estimates.items()}
    row = {name_: relative.get(name_, 0.0) * (method.estimates[name_].value or 0.0)
           for name_ in method.parameters} | {'shared': shared}
    judged = [r for r in judge(estimates, prepared.nominal, prepared.config)
              if r.code is Code.SCALE_SIGMA_TOO_LARGE]
    return replace(
        method, estimates=estimates, sources=(*method.sources, Source(name, effects, shared)),
        details=method.details | {'budget': method.details.get('budget', {}) | {name: row}},
        border=method.border and method.border.loosened({'scale_factor':
                                                         relative['scale_factor']}),
        reasons=(*(r for r in method.reasons if r.code is not Code.SCALE_SIGMA_TOO_LARGE),
                 *judged))


def held(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """
    Return a method's result with the change of one wheel in its sigmas, or as it was.

    A wheel that slips all along from some moment on, or loses air, leaves a scale between that of
    before and that of after; the fixes do not determine which of them is the vehicle's.
    """
    change = abs(prepared.wheel_slips.change)
    if not change:
        return method
    # halves of the path half the change apart in the mean of two wheels: the mean is a quarter off
    mean, own = change / 2 / prepared.wheel_slips.count, change / 2
    return with_scale_error(method, prepared, 'slow_wheel_slip', dict.fromkeys(SCALES, mean)
                            | dict.fromkeys(wheel_factors(method.estimates), own))


def upright(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """
    Return a method's result as it was, or of an IMU without force: hills in, no angles.

    ``screening/leg_kind.py`` says why.
    """
    if prepared.inputs.felt:
        return method
    hills = 5e-4    # of the scale: half the mean square of slopes of 3 %, which make a path longer
    method = with_scale_error(method, prepared, 'hills', dict.fromkeys(SCALES, hills))
    # what NO_ACCELEROMETER says of the angles, with another remedy
    said = {Code.PITCH_NOT_DETERMINED} | (
        set() if prepared.alignment.heading_separable else {Code.YAW_NOT_SEPARABLE})
    return replace(
        method, reasons=tuple(r for r in method.reasons if r.code not in said), estimates={
            name: replace(e, value=None, sigma=None) if name == 'pitch_mounting_angle' else e
            for name, e in method.estimates.items()})
