# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Errors of the scale that no method models (truncated speeds, slow wheel slip, unknown slopes).

They are added to the sigmas and the budget of a method's result. Coarse odometers and delays are
reported, delays with the setting that corrects them.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from odocal_ros.calib.result import MethodResult, Source, wheel_factors
from odocal_ros.calib.value_limits import check_limits, speed_unit
from odocal_ros.nav.coarse_speed import CoarseSpeed
from odocal_ros.pipeline.prepared_leg import PreparedLeg
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs, LocatedFixes
from odocal_ros.settings.levels import REMARK_SIGMAS

SCALES = ('scale_factor', 'scale_ratio')
SENSOR_LABEL = {'gnss': 'fix', 'odometer': 'odometer'}


def with_scale_error(method: MethodResult, prepared: PreparedLeg, name: str,
                     relative: Mapping[str, float], shared: bool = False) -> MethodResult:
    """
    Return a method's result with an error in the sigmas of its scales.

    name : of the source.   relative : relative 1 sigma of each of SCALES; for a wheel by default
    that of the scale factor.   shared : the same in every leg of the vehicle.
    """
    if not method.estimates['scale_factor'].value:
        return method
    relative = dict.fromkeys(wheel_factors(method.estimates),
                             relative['scale_factor']) | dict(relative)
    effects = np.array([[relative.get(parameter, 0.0)] for parameter in method.parameters])
    estimates = dict(method.estimates)
    for parameter, relative_sigma in relative.items():
        estimate = estimates.get(parameter)
        if estimate and estimate.value is not None and estimate.sigma is not None:
            estimates[parameter] = replace(estimate, sigma=float(np.hypot(
                estimate.sigma, relative_sigma * estimate.value)))
    row = {parameter: relative.get(parameter, 0.0) * (method.estimates[parameter].value or 0.0)
           for parameter in method.parameters} | {'shared': shared}
    sigma_reasons = [reason for reason in check_limits(estimates, prepared.nominal_scale,
                                                       prepared.config)
                     if reason.code is Code.SCALE_SIGMA_TOO_LARGE]
    return replace(
        method, estimates=estimates, sources=(*method.sources, Source(name, effects, shared)),
        details=method.details | {'budget': method.details.get('budget', {}) | {name: row}},
        marginal=method.marginal and method.marginal.with_leg_errors(
            {'scale_factor': relative['scale_factor']}),
        reasons=(*(reason for reason in method.reasons
                   if reason.code is not Code.SCALE_SIGMA_TOO_LARGE), *sigma_reasons))


def with_wheel_change(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return a method's result with the change of one wheel, if any, in its sigmas."""
    change = abs(prepared.wheel_slips.change)
    if not change:
        return method
    # the mean of ``count`` wheels changes by change / count: the error is half of it
    mean_error, wheel_error = change / 2 / prepared.wheel_slips.count, change / 2
    return with_scale_error(method, prepared, 'slow_wheel_slip', dict.fromkeys(SCALES, mean_error)
                            | dict.fromkeys(wheel_factors(method.estimates), wheel_error))


def with_hills(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return a result, without an accelerometer with the error of hills and without pitch."""
    if prepared.inputs.has_accelerometer:
        return method
    # relative: slopes of 3 % make the path longer by half their mean square
    hills_error = 5e-4
    method = with_scale_error(method, prepared, 'hills', dict.fromkeys(SCALES, hills_error))
    # reported by NO_ACCELEROMETER, with another remedy
    dropped_codes = {Code.PITCH_NOT_DETERMINED} | (
        set() if prepared.alignment.heading_separable else {Code.YAW_NOT_SEPARABLE})
    return replace(
        method, reasons=tuple(reason for reason in method.reasons
                              if reason.code not in dropped_codes),
        estimates=method.estimates | {'pitch_mounting_angle': replace(
            method.estimates['pitch_mounting_angle'], value=None, sigma=None)})


def half_step(inputs: Inputs) -> float:
    """Return half a step over the mean speed, the bias of truncated speeds; 0.0 without steps."""
    coarse = _coarse_speed(inputs)
    if coarse is None:
        return 0.0
    moves = (coarse.t >= 0.0) & (coarse.t <= inputs.t_stop) & (coarse.value != 0)
    return coarse.truncation / float(np.abs(coarse.value[moves]).mean()) if moves.any() else 0.0


def with_truncation(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return a method's result, with truncation in its sigmas if the method integrates speeds."""
    size = half_step(prepared.inputs)
    if method.name != 'two_point' or not size:
        return method
    return with_scale_error(method, prepared, 'speed_truncation', dict.fromkeys(SCALES, size),
                            shared=True)


def coarse_reasons(inputs: Inputs, located: LocatedFixes) -> list[Reason]:
    """Return the reasons for coarse steps of speed or counts."""
    relative_half_step = half_step(inputs)
    count_m = inputs.travel.quantum * (located.nominal_scale or located.rough_scale)
    coarse_count_m = 0.2    # m, least size of a coarse count
    if count_m > coarse_count_m:
        return [Reason(Code.COUNTER_COARSE, f'one count is {count_m:.2f} m, so each counter value '
                       'lags by up to this distance')]
    coarse = _coarse_speed(inputs)
    reported_from = 5e-4    # relative: least half step that is reported
    if coarse is None or coarse.truncation and relative_half_step < reported_from:
        return []
    step = _speed_text(coarse.step, located.rough_scale, inputs.scale_unit)
    if not coarse.truncation:
        return [Reason(Code.SPEED_ON_CHANGE, 'odometer speed is held until it has changed by '
                       f'{step}; half a step is added in the direction of the last change')]
    between = ', with interpolated values between' if coarse.interpolated else ''
    return [Reason(Code.SPEED_COARSE, f'odometer resolution is {step}{between}; if truncated, '
                   f'the distance is {100 * relative_half_step:.2g} % too short')]


def _speed_text(step: float, scale: float, scale_unit: str) -> str:
    """Return a step of speed in the published unit, and in another."""
    factor, unit = (scale, 'rad/s') if scale_unit == 'm/rad' else speed_unit(scale)
    speed = f'{factor * step:.3g} m/s'
    return f'{speed} ({3.6 * factor * step:.3g} km/h)' if unit in ('', 'm/s') else (
        f'{step:.3g} {unit} ({speed})')


def _coarse_speed(inputs: Inputs) -> CoarseSpeed | None:
    """Return the coarse speed of the first travel that has one, None if there is none."""
    return next((travel.coarse for travel in (inputs.travel, *inputs.travels) if travel.coarse),
                None)


def delay_notes(prepared: PreparedLeg, delays: Mapping[str, tuple[float, float]],
                scale: float) -> list[Reason]:
    """Return DELAY_SEEN for each (delay, sigma), s, that is significant and has an effect."""
    speed = _high_speed(prepared) * scale
    notes = []
    # m, the required accuracy of a lever arm; smaller effects than a quarter of a fix's sigma are
    # not observable
    observable_m = max(0.1, 0.25 * prepared.fix_sigma)
    for name, (delay, sigma) in delays.items():
        metres = abs(delay) * speed
        if name in prepared.inputs.clock_delays or not (
                abs(delay) > REMARK_SIGMAS * sigma and metres > observable_m):
            continue        # the delay of an aligned clock is reported already: this is the rest
        time_offset = getattr(prepared.config, name).time_offset
        notes.append(Reason(
            Code.DELAY_SEEN, f'{SENSOR_LABEL[name]} stamps are {abs(delay):.3f} s '
            f'(± {sigma:.3f} s) {"late" if delay > 0 else "early"} relative to the other sensors, '
            f'{metres:.2g} m at {speed:.1f} m/s; accounted for. To remove the delay, set '
            f'{name}.time_offset to {time_offset - delay:.3f}'
            + (f' (now {time_offset:g})' if time_offset else '')))
    return notes


def _high_speed(prepared: PreparedLeg) -> float:
    """Return the 90th percentile of the speed, scale units per s."""
    travel = prepared.inputs.travel
    grid = np.arange(max(0.0, travel.t[0]), min(prepared.inputs.t_stop, travel.t[-1]), 1.0)
    if len(grid) < 2:
        return 0.0
    return float(np.percentile(np.abs(np.diff(travel.at(grid))), 90))
