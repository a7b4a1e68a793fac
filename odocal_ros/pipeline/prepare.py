# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Preparation of a screened leg for the methods: orientation, alignment, dead reckoning."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from odocal_ros.calib import drive
from odocal_ros.calib.gyro_axes import check_turns
from odocal_ros.calib.mounting import with_mounting_remedy
from odocal_ros.calib.slip import join_axles, NO_SLIPS, WheelSlips
from odocal_ros.data.arrays import release_mapped_memory, running_sum
from odocal_ros.data.leg import Leg
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.dead_reckoning import dead_reckon, Track
from odocal_ros.pipeline.align import align, attitude_of, with_observed_walk
from odocal_ros.pipeline.beyond_model import coarse_reasons
from odocal_ros.pipeline.prepared_leg import PreparedLeg
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening import imu_orientation
from odocal_ros.screening.axles import pair_wheels
from odocal_ros.screening.imu_faults import forward_turn_reasons
from odocal_ros.screening.inputs import Inputs, locate_fixes, LocatedFixes
from odocal_ros.screening.local_frame import local_frame_reasons
from odocal_ros.screening.row_screen import imu_gap
from odocal_ros.settings.config import Config, DIFFERENTIAL

SCALE_LIMIT_CODES = {Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW}     # of limits in metres
WHEEL_FAULT_CODES = {Code.WHEEL_DEAD, Code.WHEEL_REVERSED}


def prepare(leg: Leg, inputs: Inputs, config: Config, reasons: Sequence[Reason] = (),
            alignment: Alignment | None = None,
            holdout: bool = False) -> tuple[PreparedLeg | None, tuple[Reason, ...]]:
    """
    Return a leg prepared for the methods, None if none can be run on it, and all reasons.

    reasons : those found so far.   alignment : used instead of the leg's own.   holdout : hold the
    last fifth of the distance out of the fit.
    """
    located = locate_fixes(inputs, config)
    release_mapped_memory()
    refusal_reasons = _missing_drive_reasons(inputs, located)
    if refusal_reasons is not None:
        return None, (*reasons, *refusal_reasons)
    accelerations = (imu_orientation.accelerations(inputs, located.rough_scale)
                     if inputs.has_accelerometer else None)
    orientation = None if accelerations is None else imu_orientation.orientation_of(accelerations)
    reasons = (*reasons, *drive.odometer_span_reasons(inputs.travel, inputs.t_stop))
    axis_faults = forward_turn_reasons(accelerations)
    if not axis_faults:
        _, axis_faults = check_turns(inputs, located, orientation, config.imu.gyro_scale)
    if axis_faults:             # a mirrored axis turns the orientation around
        return None, (*reasons, *axis_faults)
    axis_reasons = imu_orientation.orientation_reasons(orientation, config.imu.nominal_yaw)
    reasons = (*reasons, *with_mounting_remedy(axis_reasons, inputs))
    if Code.IMU_AXES in {r.code for r in axis_reasons}:
        return None, reasons
    prepared = _dead_reckoned(leg, inputs, config, located, orientation, reasons, alignment,
                              holdout)
    return prepared, prepared.reasons


def _dead_reckoned(leg: Leg, inputs: Inputs, config: Config, located: LocatedFixes,
                   orientation: imu_orientation.ImuOrientation | None, reasons: Sequence[Reason],
                   alignment: Alignment | None, holdout: bool) -> PreparedLeg:
    """Return a leg aligned and dead-reckoned, with the checks of its track; as ``prepare``."""
    spans = inputs.standstills(located.rough_scale, config)
    alignment_reasons: tuple[Reason, ...] = ()
    is_own_alignment = alignment is None
    if alignment is None:
        alignment, alignment_reasons = align(inputs, spans, located.rough_scale, located.fixes_n,
                                             located.origin, config)
    release_mapped_memory()
    gap_reasons = imu_gap(inputs.t_imu, min(alignment.t, 0.0), inputs.t_stop, config.leg.max_gap)
    epochs = attitude_of(inputs, located.origin, alignment.t, alignment.q_nb, alignment.gyro_bias)
    if is_own_alignment:
        alignment = with_observed_walk(alignment, inputs, spans, epochs,
                                       located.origin.earth_rate_n)
    track = dead_reckon(*epochs, inputs.travel)
    wheel_reasons, wheel_slips = _compare_wheels(inputs, config, located, track, reasons)
    distance, drive_reasons = drive.check_drive(track, inputs.t_stop, located.rough_scale,
                                                config.leg)
    # only methods by end points need straight legs
    end_point_reasons = tuple(r for r in drive_reasons if r.code is Code.LEG_NOT_STRAIGHT)
    return PreparedLeg(
        **vars(located), leg=leg, inputs=inputs, config=config, imu_orientation=orientation,
        lever_v=np.subtract(config.gnss.lever_arm, config.odometer.lever_arm),
        standstills=spans, alignment=alignment, alignment_reasons=alignment_reasons, epochs=epochs,
        track=track, wheel_slips=wheel_slips, metres_per_unit=located.rough_scale,
        distance=distance,
        t_fit=_time_of_four_fifths(track, inputs.t_stop) if holdout else inputs.t_stop,
        holdout=holdout,
        reasons=(*reasons, *gap_reasons, *coarse_reasons(inputs, located), *wheel_reasons,
                 *(r for r in drive_reasons if r not in end_point_reasons)),
        end_point_reasons=end_point_reasons)


def checked_with_scale(prepared: PreparedLeg, scale: float) -> PreparedLeg:
    """Return a leg with distance and speed checked by a more accurate scale."""
    distance, drive_reasons = drive.check_path_and_speed(
        prepared.track, prepared.inputs.t_stop, scale, prepared.config.leg)
    return replace(prepared, metres_per_unit=scale, distance=distance, reasons=(
        *(r for r in prepared.reasons if r.code not in SCALE_LIMIT_CODES), *drive_reasons))


def _missing_drive_reasons(inputs: Inputs, located: LocatedFixes) -> tuple[Reason, ...] | None:
    """Return the reasons why there is no usable drive, None if there is one."""
    refusal_reasons = local_frame_reasons(inputs, located, DIFFERENTIAL) or drive.motion_reasons(
        inputs.travel, inputs.t_fix, located.fixes_n, located.fix_sigma, inputs.t_stop,
        inputs.min_motion)
    if refusal_reasons:
        return refusal_reasons
    if not located.rough_scale:
        return (Reason(Code.LEG_TOO_SHORT, 'the fixes move too little to estimate a scale',
                       'Drive farther between the marks. If the vehicle did, check the receiver '
                       '(static hold off).'),)
    between_marks = (inputs.t_imu >= 0.0) & (inputs.t_imu <= inputs.t_stop)
    min_rows = 4    # of the IMU between the marks, for an attitude
    if between_marks.sum() < min_rows:
        return imu_gap(inputs.t_imu, 0.0, inputs.t_stop, 0.0)
    return None


def _compare_wheels(inputs: Inputs, config: Config, located: LocatedFixes, track: Track,
                    reasons: Sequence[Reason]) -> tuple[tuple[Reason, ...], WheelSlips]:
    """Return the faults found by comparing left and right wheels, and the slips of one of them."""
    fixed_axles = [axle for axle in pair_wheels(inputs.travels)
                   if len(axle) > 1 and not axle[0].distance_ahead]
    has_fault = bool(WHEEL_FAULT_CODES & {r.code for r in reasons})
    if not fixed_axles or not inputs.has_accelerometer or has_fault:
        return (), NO_SLIPS
    from odocal_ros.calib.wheel_faults import wheel_faults
    odometer, count = config.odometer, sum(not wheel.distance_ahead for wheel in inputs.travels)
    axle_reasons, wheel_slips = zip(*(wheel_faults(
        axle, inputs.imu, inputs.t_stop, track, located.origin.latitude,
        located.rough_scale, odometer.track_width, inputs.uncertain_t,
        odometer.max_scale_deviation, count) for axle in fixed_axles), strict=True)
    return tuple(chain(*axle_reasons)), join_axles(wheel_slips, count)


def _time_of_four_fifths(track: Track, t_stop: float) -> float:
    """Return the time at which four fifths of the distance are driven, s."""
    inside = (track.t >= 0) & (track.t <= t_stop)
    s = track.s[inside]
    path_length = running_sum(np.abs(np.diff(s)))
    return float(track.t[inside][np.searchsorted(path_length, 0.8 * path_length[-1])])
