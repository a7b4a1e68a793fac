# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The drive in a bag, for odocal inspect: findings that need IMU, odometer and fixes together.

They are the mounting of the IMU, units, the legs that replay would use, and other possible legs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np

from odocal_ros.bagio.read import Bag
from odocal_ros.calib.drive import motion_reasons, path_and_chord
from odocal_ros.calib.gyro_axes import check_turns
from odocal_ros.calib.mounting import estimate_mounting, with_mounting_remedy
from odocal_ros.calib.two_point import MIN_CHORD_SHARE
from odocal_ros.calib.value_limits import far_from_nominal
from odocal_ros.data.arrays import Floats, lengths, medians
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadData, BadUsage
from odocal_ros.library.arguments import EACH_STOP, LegSpan
from odocal_ros.library.find_legs import (
    find_legs,
    marked_legs,
    standstills_of,
    zero_of_times,
)
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.offline import survey
from odocal_ros.pipeline.calibrate import missing_data_reasons
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening import imu_orientation
from odocal_ros.screening.clocks import SYNCHRONISE_REMEDY
from odocal_ros.screening.fix_screen import usable_fixes
from odocal_ros.screening.imu_faults import gravity_turn_reasons, unit_change_reasons
from odocal_ros.screening.inputs import Inputs, locate_fixes, LocatedFixes
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.screening.screen import screen_aligned
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import RAD_PER_DEG
from odocal_ros.settings.nominal import G, nominal_scale

# judgement: net share of the path length that a vehicle drives backwards in a recording. If it
# seems to be larger, the counter decreases, and the IMU would seem to be mounted backwards
MAX_BACKWARD_SHARE = 0.5


@dataclass
class DriveInspection:
    """Content of a drive; entries that cannot be computed are empty."""

    # entries of ``inspection.inspect``
    content: dict[str, Any] = field(default_factory=lambda: {
        'mounting': None, 'drive': None, 'standstills': [], 'legs': [], 'each_stop': [],
        'straight': []})
    findings: list[Reason] = field(default_factory=list)
    options: list[str] = field(default_factory=list)      # of replay: settings, and --leg


def inspect_drive(bag: Bag, recorder: LegRecorder, config: Config) -> DriveInspection:
    """Return the inspection of a drive from the samples of its inputs."""
    result = DriveInspection()
    if not all(len(recorder.rows(slot).stamp_ns) for slot in ('imu', 'odometer')):
        return result
    try:
        (first_ns, last_ns), = find_legs(recorder, bag, [LegSpan(None, None)], [], config)
        leg = recorder.close(first_ns, last_ns, preroll=0.0)
    except (BadData, BadUsage) as error:
        result.findings.append(Reason(Code.CLOCKS_DIFFER, str(error), SYNCHRONISE_REMEDY))
        return result
    config = settings_by_frame(leg.fix, config)
    leg, inputs, reasons = screen_aligned(leg, config)
    result.findings += [reason for reason in reasons if reason.code is not Code.NO_FIX or len(
        recorder.rows('fix').stamp_ns)]
    if len(inputs.t_imu) < 3 or len(inputs.travel.t) < 2:
        codes = {reason.code for reason in result.findings}
        result.findings += [reason for reason in missing_data_reasons(leg, inputs)
                            if reason.code not in codes]
        return result
    result.findings += with_mounting_remedy(
        gravity_turn_reasons(inputs) or imu_orientation.unit_and_axis_reasons(
            inputs.median_f_b, inputs.w_b, inputs.C_bi, config.imu)[0]
        or unit_change_reasons(inputs), inputs)
    result.options, w_i, f_i = _unit_options(inputs, config)
    located = locate_fixes(inputs, config)
    still_reasons = [reason for reason in motion_reasons(
        inputs.travel, inputs.t_fix, located.fixes_n, located.fix_sigma, inputs.t_stop,
        inputs.min_motion) if reason.code is Code.ODOMETER_STILL]
    if still_reasons:       # without travel there are no scale, speeds, standstills and axes
        result.findings += still_reasons
        return result
    standstills, speeds = survey.stops_and_speeds(inputs, located.rough_scale, config)
    drive = _drive_facts(inputs, located, speeds)
    if drive['rough_scale']:
        result.findings += far_from_nominal(
            float(f'{drive["rough_scale"]:.3g}'), inputs.scale_unit,
            nominal_scale(config, inputs.scale_unit), config)
    mounting, travel = _mounting_facts(inputs, located, w_i, f_i, config)
    drive['gyro_over_course'], axis_faults = _check_gyro(inputs, located, w_i, config)
    result.findings += axis_faults
    if travel is not inputs.travel:
        result.options.append(f'odometer.reversed={str(not config.odometer.reversed).lower()}')
    # no rotation corrects a mirrored axis
    if mounting['needed'] and not axis_faults:
        rpy = ', '.join(f'{angle:.10g}' for angle in mounting['rpy'])
        result.options.append(f'imu.mounting_rpy=[{rpy}]')
    # s: times of a leg start at its first sample
    offset = (first_ns - zero_of_times(bag, first_ns, last_ns)) * 1e-9
    legs, leg_options = _describe_legs(bag, recorder, inputs, located, standstills, offset,
                                       first_ns, config)
    result.options += [*_sigma_limit(recorder, config), *leg_options]
    result.content |= {'drive': drive, 'mounting': mounting, **legs, 'standstills': [
        [offset + begin, offset + end] for begin, end in standstills.tolist()]}
    return result


def _drive_facts(inputs: Inputs, located: LocatedFixes, speeds: list[float]) -> dict[str, Any]:
    """Return path length, scale and speeds; speeds: lowest and highest by the rough scale, m/s."""
    path_length, chord = path_and_chord(inputs.t_fix, located.fixes_n, inputs.min_motion)
    travel = _travel_between_fixes(inputs)
    is_long = path_length > 2.5 * inputs.min_motion      # judgement: then it is accurate to 1 %
    scale = path_length / travel if is_long and travel else located.rough_scale or None
    # the speeds are multiplied by it, so that they belong to this scale
    scale_ratio = scale / located.rough_scale if scale and located.rough_scale else 1.0
    return {'distance': path_length, 'chord': chord, 'fix_sigma': located.fix_sigma,
            'rough_scale': scale, 'scale_unit': inputs.scale_unit,
            'slowest': speeds[0] * scale_ratio, 'fastest': speeds[1] * scale_ratio,
            'usable_fixes': len(inputs.t_fix), 'travel': travel}


def _travel_between_fixes(inputs: Inputs) -> float:
    """Return the travel, odometer units, between the first and last fix; all without two fixes."""
    t, s = inputs.travel.t, inputs.travel.s
    if len(inputs.t_fix) > 1:
        ends = inputs.t_fix[[0, -1]]
        inside = (t > ends[0]) & (t < ends[1])
        s = np.concatenate([inputs.travel.at(ends[:1]), s[inside], inputs.travel.at(ends[1:])])
    return float(np.abs(np.diff(s)).sum())


def _unit_options(inputs: Inputs, config: Config) -> tuple[list[str], Floats, Floats]:
    """Return the settings for the units of the IMU; turn rates, rad/s, and forces, (n, 3) in i."""
    w_i, f_i = inputs.w_b, inputs.f_b
    if not np.array_equal(inputs.C_bi, np.eye(3)):
        w_i, f_i = w_i @ inputs.C_bi, f_i @ inputs.C_bi
    options = []
    if 0.85 < np.linalg.norm(medians(f_i)) < 1.15:      # in g
        options.append(f'imu.accel_scale={G * config.imu.accel_scale:.10g}')
    if np.percentile(lengths(w_i - medians(w_i)), 99.9) > imu_orientation.MAX_RATE:
        options.append(f'imu.gyro_scale={RAD_PER_DEG * config.imu.gyro_scale!r}')
        w_i = w_i * RAD_PER_DEG
    return options, w_i, f_i


def _sigma_limit(recorder: LegRecorder, config: Config) -> list[str]:
    """Return the option that removes gnss.max_sigma if this limit drops most of the fixes."""
    rows = recorder.rows('fix')
    if math.isnan(config.gnss.max_sigma):
        return []
    all_count, kept = (int(usable_fixes(rows, 0, replace(config.gnss, max_sigma=limit))[0].sum())
                       for limit in (0.0, config.gnss.max_sigma))
    return ['gnss.max_sigma=nan'] if kept < all_count / 2 else []


def _mounting_facts(inputs: Inputs, located: LocatedFixes, w_i: Floats, f_i: Floats,
                    config: Config) -> tuple[dict[str, Any], Travel]:
    """Return facts on the orientation of the IMU, and the travel, negated if it decreases."""
    is_configured = bool(np.any(config.imu.mounting_rpy))
    travel, step = inputs.travel, np.diff(inputs.travel.s)
    if not is_configured and step.sum() < -MAX_BACKWARD_SHARE * np.abs(step).sum():
        travel = replace(travel, s=-travel.s)
    axes = estimate_mounting(inputs.t_imu, w_i, f_i, travel, located.rough_scale or 1.0)
    if not inputs.has_accelerometer:
        axes = replace(axes, C_bi=None)      # gravity is assumed
    agrees = axes.C_bi is not None and np.allclose(
        axes.C_bi, matrix_from_rpy(config.imu.mounting_rpy), atol=0.1)
    return {
        'accelerometer': inputs.has_accelerometer, 'rpy': axes.rpy,
        'assumed_forward': axes.assumed, 'deviation': axes.deviation,
        'unclear': axes.why_unknown + '; imu.mounting_rpy is used as set' * is_configured,
        'forward_i': None if axes.forward_i is None else axes.forward_i.tolist(),
        'forward_sigma': axes.forward_sigma if axes.forward_i is not None else None,
        'needed': axes.rpy is not None and not agrees and not is_configured}, travel


def _check_gyro(inputs: Inputs, located: LocatedFixes, w_i: Floats,
                config: Config) -> tuple[float | None, Sequence[Reason]]:
    """Return the ratio of gyro turns to course turns, None if unknown; reasons for wrong axes."""
    orientation = imu_orientation.estimate_orientation(inputs, located.rough_scale) \
        if inputs.has_accelerometer and located.rough_scale else None
    return check_turns(replace(inputs, w_b=w_i @ inputs.C_bi.T), located, orientation,
                       config.imu.gyro_scale)


def _describe_legs(bag: Bag, recorder: LegRecorder, inputs: Inputs, located: LocatedFixes,
                   standstills: Floats, offset: float, first_ns: int,
                   config: Config) -> tuple[dict[str, Any], list[str]]:
    """
    Return the legs that replay would use and other possible ones, and options for better ones.

    standstills : (k, 2) s.   offset : added to times, s.   first_ns : stamp of t = 0.
    """
    if not len(inputs.t_fix):
        return {}, []

    def leg_facts(start_ns: int, stop_ns: int) -> dict[str, Any]:
        start, stop = (start_ns - first_ns) * 1e-9, (stop_ns - first_ns) * 1e-9
        in_leg = (inputs.t_fix >= start) & (inputs.t_fix <= stop)
        path_length, chord = path_and_chord(inputs.t_fix[in_leg], located.fixes_n[in_leg],
                                            inputs.min_motion)
        return {'start': offset + start, 'stop': offset + stop, 'distance': path_length,
                'chord': chord}

    marks = marked_legs(bag)
    stops = standstills_of(inputs, first_ns, config)
    legs = [leg_facts(*span) | {'marked': bool(marks)}
            for span in find_legs(recorder, bag, [], marks, config, stops)]
    each_stop = [leg_facts(*span) for span in find_legs(
        recorder, bag, [EACH_STOP], [], config, stops)] if len(standstills) > 2 else []
    straight = [leg_facts(*(first_ns + round(t * 1e9) for t in _from_rest(standstills, *ends)))
                for ends in survey.straight_sections(inputs, located,
                                                     config.leg.min_distance)[:5]]
    content = {'legs': legs, 'each_stop': each_stop, 'straight': straight}
    # sections are suggested for the two-point method only: others use all turns and stops
    if marks or config.method != 'two_point' or not all(map(is_closed, legs)):
        return content, []
    open_legs = [leg for leg in each_stop
                 if leg['distance'] >= config.leg.min_distance and not is_closed(leg)]
    if len(open_legs) > 1 and len(open_legs) == len(each_stop):
        return content, ['--leg each-stop']
    return content, [f'--leg {leg["start"]:.1f}:{leg["stop"]:.1f}' for leg in straight]


def is_closed(leg: dict[str, Any]) -> bool:
    """Return True if a leg ends near its start: the limit is a share of the path length."""
    return bool(leg['chord'] < MIN_CHORD_SHARE * leg['distance'])


def _from_rest(standstills: Floats, start: float, stop: float) -> tuple[float, float]:
    """Return a start and a stop, s; a time in a standstill becomes the end of the standstill."""
    start, stop = (next((end for begin, end in standstills.tolist() if begin <= t <= end), t)
                   for t in (start, stop))
    return start, stop
