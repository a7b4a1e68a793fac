# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An odometer in coarse steps: what is said of it, and what it does to methods that add it up."""

import numpy as np

from odocal_ros.calib.result import MethodResult
from odocal_ros.nav.coarse_speed import CoarseSpeed
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.pipeline.scale_error import SCALES, with_scale_error
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs, Placed

NAME = 'speed_truncation'


def half_step(inputs: Inputs) -> float:
    """
    Return half a step of the speed relative to the path length, 0.0 without steps.

    Speeds sent are too low by that on the mean where the sender truncates, by nothing where it
    rounds, and the grid does not say which.
    """
    coarse = _coarse(inputs)
    if coarse is None:
        return 0.0
    pick = (coarse.t >= 0.0) & (coarse.t <= inputs.t_stop) & (coarse.value != 0)
    mean = float(np.abs(coarse.value[pick]).mean()) if pick.any() else 0.0
    return coarse.truncation / mean if mean else 0.0


def held_steps(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return the result of a method that adds up speeds, what truncation takes in its sigmas."""
    size = half_step(prepared.inputs)
    if method.name != 'two_point' or not size:
        return method
    return with_scale_error(method, prepared, NAME, dict.fromkeys(SCALES, size), shared=True)


def coarse_reasons(inputs: Inputs, placed: Placed) -> list[Reason]:
    """Return the reasons for coarse steps of speed or counts."""
    K, size = placed.nominal or placed.rough, half_step(inputs)
    count = inputs.travel.quantum * K
    coarse_count_m = 0.2    # m, a count that is
    if count > coarse_count_m:
        return [Reason(Code.COUNTER_COARSE, f'one count is {count:.2f} m, so each reading lags '
                       'by up to this distance')]
    coarse = _coarse(inputs)
    coarse_worth = 5e-4    # of the scale: half a step that is worth a word
    if coarse is None or coarse.truncation and size < coarse_worth:
        return []
    metres = coarse.step * K
    sent = f'{coarse.step:.3g} rad/s ({metres:.3g} m/s)' if inputs.scale_unit == 'm/rad' \
        else f'{coarse.step:.3g} m/s ({3.6 * coarse.step:.3g} km/h)'
    if not coarse.truncation:
        return [Reason(Code.SPEED_ON_CHANGE, 'odometer speed repeats until it has changed by '
                       f'{sent}; half a step is added in the direction of the last change')]
    between = ', with interpolated values between' if coarse.interpolated else ''
    return [Reason(Code.SPEED_COARSE, f'odometer resolution is {sent}{between}; if truncated, '
                   f'the distance is {100 * size:.2g} % too short')]


def _coarse(inputs: Inputs) -> CoarseSpeed | None:
    """Return the grid of the speed, of one of several wheels, None where there is none."""
    return next((one.coarse for one in (inputs.travel, *inputs.travels) if one.coarse), None)
