# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The drive in a bag, for odocal inspect: what IMU, odometer and fixes show only together.

In: the samples of the selected topics. Out: path, speeds, standstills, legs and IMU orientation,
findings on units, axes and missing data, and the settings that correct them.
"""

from dataclasses import replace
import math
from typing import Any

import numpy as np

from odocal_ros.bagio.read import Bag
from odocal_ros.calib.drive import motion_reasons, path_and_chord, speed_reason
from odocal_ros.calib.gyro_axes import check_turns
from odocal_ros.calib.mounting import estimate_mounting, with_mounting_remedy
from odocal_ros.calib.two_point import MIN_CHORD_SHARE
from odocal_ros.calib.value_limits import far_from_nominal
from odocal_ros.data.arrays import Floats, lengths, medians
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadData, BadUsage
from odocal_ros.library.arguments import EACH_STOP, LegSpan
from odocal_ros.library.find_legs import find_legs, marked_legs, standstills_of
from odocal_ros.library.topics import NO_MESSAGES_REMEDY, topics_without_messages
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
from odocal_ros.settings.nominal import nominal_scale

# judgement: of the path length; no vehicle drives a larger net share of a recording backwards.
# With a counter that counts down, the IMU would seem to be mounted backwards
MAX_BACKWARD_SHARE = 0.5


def inspect_drive(bag: Bag, recorder: LegRecorder, config: Config, content: dict[str, Any],
                  findings: list[Reason]) -> list[str]:
    """
    Inspect the inputs together.

    Fills mounting, drive, standstills and legs of ``content``, adds to ``findings``, and returns
    options for the replay: settings, and --leg.
    """
    if not all(len(recorder.rows(slot).stamp_ns) for slot in ('imu', 'odometer')):
        return []
    try:
        (first, last), = find_legs(recorder, bag, [LegSpan(None, None)], [], config)      # ns
        leg = recorder.close(first, last, preroll=0.0)
    except (BadData, BadUsage) as error:
        findings.append(Reason(Code.CLOCKS_DIFFER, str(error), SYNCHRONISE_REMEDY))
        return []
    config = settings_by_frame(leg.fix, config)
    leg, inputs, reasons = screen_aligned(leg, config)
    findings += [r for r in reasons if r.code is not Code.NO_FIX or len(
        recorder.rows('fix').stamp_ns)]
    if len(inputs.t_imu) < 3 or len(inputs.travel.t) < 2:
        known = {reason.code for reason in findings}
        findings += [r for r in missing_data_reasons(leg, inputs) if r.code not in known]
        return []
    base = (first - bag.start_ns) * 1e-9      # s: times of the leg start at its first sample
    options, w_i, f_i = _unit_options(inputs, config, findings)
    located = locate_fixes(inputs, config)
    still_reasons = [reason for reason in motion_reasons(
        inputs.travel, inputs.t_fix, located.fixes_n, located.fix_sigma, inputs.t_stop,
        inputs.min_motion) if reason.code is Code.ODOMETER_STILL]
    if still_reasons:       # scale, speeds, standstills and axes are computed from the counts
        findings += still_reasons
        return options
    stops, speeds = survey.stops_and_speeds(inputs, located.rough_scale, config)
    path_length, chord = path_and_chord(inputs.t_fix, located.fixes_n, inputs.min_motion)
    travel = _travel_between_fixes(inputs)
    is_long = path_length > 2.5 * inputs.min_motion      # judgement: then it is accurate to 1 %
    scale = path_length / travel if is_long and travel else located.rough_scale or None
    # speeds with the printed scale
    scale_ratio = scale / located.rough_scale if scale and located.rough_scale else 1.0
    content['drive'] = {
        'distance': path_length, 'chord': chord, 'fix_sigma': located.fix_sigma,
        'rough_scale': scale, 'scale_unit': inputs.scale_unit,
        'slowest': speeds[0] * scale_ratio, 'fastest': speeds[1] * scale_ratio,
        'usable_fixes': len(inputs.t_fix), 'travel': travel}
    if scale:
        findings += far_from_nominal(float(f'{scale:.3g}'), inputs.scale_unit,
                                     nominal_scale(config, inputs.scale_unit), config)
    content['standstills'] = [[base + a, base + b] for a, b in stops.tolist()]
    return [*options, *_axis_options(inputs, located, w_i, f_i, config, content, findings),
            *_sigma_limit(recorder, config),
            *_describe_legs(bag, recorder, inputs, located, stops, first, config, content)]


def _travel_between_fixes(inputs: Inputs) -> float:
    """Return the travel between the first and the last fix (else all), in odometer units."""
    t, s = inputs.travel.t, inputs.travel.s
    if len(inputs.t_fix) > 1:
        ends = inputs.t_fix[[0, -1]]
        inside = (t > ends[0]) & (t < ends[1])
        s = np.concatenate([inputs.travel.at(ends[:1]), s[inside], inputs.travel.at(ends[1:])])
    return float(np.abs(np.diff(s)).sum())


def _unit_options(inputs: Inputs, config: Config,
                  findings: list[Reason]) -> tuple[list[str], Floats, Floats]:
    """Check the IMU's units; return options for replay, rates in rad/s and forces, frame i."""
    findings += with_mounting_remedy(
        gravity_turn_reasons(inputs) or imu_orientation.unit_and_axis_reasons(
            inputs.median_f_b, inputs.w_b, inputs.C_bi, config.imu)[0]
        or unit_change_reasons(inputs), inputs)
    w_i, f_i = inputs.w_b, inputs.f_b
    if not np.array_equal(inputs.C_bi, np.eye(3)):
        w_i, f_i = w_i @ inputs.C_bi, f_i @ inputs.C_bi
    options = []
    if 0.85 < np.linalg.norm(medians(f_i)) < 1.15:      # in g
        options.append(f'imu.accel_scale={9.80665 * config.imu.accel_scale:.10g}')
    if np.percentile(lengths(w_i - medians(w_i)), 99.9) > imu_orientation.MAX_RATE:
        options.append(f'imu.gyro_scale={RAD_PER_DEG * config.imu.gyro_scale!r}')
        w_i = w_i * RAD_PER_DEG
    return options, w_i, f_i


def _sigma_limit(recorder: LegRecorder, config: Config) -> list[str]:
    """Return the default of gnss.max_sigma as an option if the limit drops most of the fixes."""
    rows = recorder.rows('fix')
    all_count, kept = (int(usable_fixes(rows, 0, replace(config.gnss, max_sigma=limit))[0].sum())
                       for limit in (0.0, config.gnss.max_sigma))
    return ['gnss.max_sigma=nan'] if kept < all_count / 2 else []


def _axis_options(inputs: Inputs, located: LocatedFixes, w_i: Floats, f_i: Floats, config: Config,
                  content: dict[str, Any], findings: list[Reason]) -> list[str]:
    """Return settings for odometer sign and IMU orientation; check the gyro."""
    is_configured = bool(np.any(config.imu.mounting_rpy))
    travel, step = inputs.travel, np.diff(inputs.travel.s)
    options = []
    if not is_configured and step.sum() < -MAX_BACKWARD_SHARE * np.abs(step).sum():
        travel = replace(travel, s=-travel.s)
        options.append(f'odometer.reversed={str(not config.odometer.reversed).lower()}')
    axes = estimate_mounting(inputs.t_imu, w_i, f_i, travel, located.rough_scale or 1.0)
    if not inputs.has_accelerometer:
        axes = replace(axes, C_bi=None)      # gravity is assumed
    agrees = axes.C_bi is not None and np.allclose(
        axes.C_bi, matrix_from_rpy(config.imu.mounting_rpy), atol=0.1)
    content['mounting'] = {
        'accelerometer': inputs.has_accelerometer, 'rpy': axes.rpy,
        'assumed_forward': axes.assumed, 'deviation': axes.deviation,
        'unclear': axes.unclear + '; imu.mounting_rpy is used as set' * is_configured,
        'forward_i': None if axes.forward_i is None else axes.forward_i.tolist(),
        'forward_sigma': axes.forward_sigma if axes.forward_i is not None else None,
        'needed': axes.rpy is not None and not agrees and not is_configured}
    orientation = imu_orientation.estimate_orientation(inputs, located.rough_scale) \
        if inputs.has_accelerometer and located.rough_scale else None
    ratio, axis_faults = check_turns(replace(inputs, w_b=w_i @ inputs.C_bi.T), located,
                                     orientation, config.imu.gyro_scale)
    content['drive']['gyro_over_course'] = ratio
    findings += axis_faults
    # no rotation corrects a mirrored axis
    if axis_faults or axes.rpy is None or not content['mounting']['needed']:
        return options
    return [*options, f'imu.mounting_rpy=[{", ".join(f"{x:.10g}" for x in axes.rpy)}]']


def _describe_legs(bag: Bag, recorder: LegRecorder, inputs: Inputs, located: LocatedFixes,
                   rests: Floats, first: int, config: Config,
                   content: dict[str, Any]) -> list[str]:
    """Add the legs that replay would use to ``content``; return options for better ones."""
    if not len(inputs.t_fix):
        return []
    base = (first - bag.start_ns) * 1e-9

    def entry_of(start_ns: int, stop_ns: int, **more: bool) -> dict[str, Any]:
        start, stop = (start_ns - first) * 1e-9, (stop_ns - first) * 1e-9
        in_leg = (inputs.t_fix >= start) & (inputs.t_fix <= stop)
        path_length, chord = path_and_chord(inputs.t_fix[in_leg], located.fixes_n[in_leg],
                                            inputs.min_motion)
        return {'start': base + start, 'stop': base + stop, 'distance': path_length,
                'chord': chord} | more

    marks = marked_legs(bag)
    stops = standstills_of(inputs, first, config)
    content['legs'] = [entry_of(a, b, marked=bool(marks))
                       for a, b in find_legs(recorder, bag, [], marks, config, stops)]
    each = find_legs(recorder, bag, [EACH_STOP], [], config, stops) if len(rests) > 2 else []
    content['each_stop'] = [entry_of(a, b) for a, b in each]
    content['straight'] = [
        entry_of(first + round(a * 1e9), first + round(b * 1e9)) for a, b in (
            _from_rest(rests, *ends)
            for ends in survey.straight_sections(inputs, located, config.leg.min_distance)[:5])]
    # the other methods gain more from the whole drive than from its sections
    if marks or config.method != 'two_point' or not all(is_closed(leg) for leg in content['legs']):
        return []
    open_legs = [leg for leg in content['each_stop']
                 if leg['distance'] >= config.leg.min_distance and not is_closed(leg)]
    if len(open_legs) > 1 and len(open_legs) == len(content['each_stop']):
        return ['--leg each-stop']
    return [f'--leg {leg["start"]:.1f}:{leg["stop"]:.1f}' for leg in content['straight']]


def is_closed(leg: dict[str, Any]) -> bool:
    """Return True if a leg ends where it starts: ratio of chord to path length."""
    return bool(leg['chord'] < MIN_CHORD_SHARE * leg['distance'])


def _from_rest(stops: Floats, start: float, stop: float) -> tuple[float, float]:
    """Move an end inside a standstill to the end of the standstill, as the marks of a leg."""
    begin, end = (next((b for a, b in stops.tolist() if a <= t <= b), t) for t in (start, stop))
    return begin, end


def missing_input_reasons(content: dict[str, Any], mapping: dict[str, str],
                          config: Config) -> list[Reason]:
    """Return the reasons for missing or unusable inputs, and for parts that the drive lacks."""
    reasons, drive = _topic_reasons(content, mapping, config), content['drive']
    if not drive:
        return reasons
    reasons += _standstill_reasons(content) + _leg_reasons(content['legs'], config)
    if 0 < drive['fastest'] < config.leg.min_speed:
        reasons.append(speed_reason(drive['fastest'], config.leg.min_speed))
    return reasons + _heading_reasons(content, mapping, config)


def _topic_reasons(content: dict[str, Any], mapping: dict[str, str],
                   config: Config) -> list[Reason]:
    """Return the reasons for inputs without a topic or without usable messages."""
    topics = {topic['name']: topic for topic in content['topics']}
    reasons = []
    for slot, code, word in (('imu', Code.NO_IMU, 'IMU'), ('odometer', Code.NO_ODOMETER,
                             'odometer'), ('fix', Code.NO_FIX, 'fixes')):
        facts = topics.get(mapping.get(slot, ''), {})
        if not facts and (slot != 'imu' or config.odometer.needs_imu):
            empty = topics_without_messages(
                {name: (topic['type'], topic['count']) for name, topic in topics.items()}, slot)
            reasons.append(Reason(
                code, f'{", ".join(empty)} has no messages', NO_MESSAGES_REMEDY) if empty else
                Reason(code, f'no topic for the {word}',
                       f'Record it, or name it with --{slot}-topic.'))
        elif 'error' in facts and 'timing' not in facts:
            reasons.append(Reason(
                code, f'{facts["name"]}: no message can be used: {facts["error"]}',
                'Check the type and the driver of the topic, or name another topic.'))
    return reasons


def _standstill_reasons(content: dict[str, Any]) -> list[Reason]:
    """Return NO_STANDSTILL if the vehicle does not stand before a leg."""
    standstills, slowest = content['standstills'], content['drive']['slowest']
    starts = [leg['start'] for leg in content['legs']]
    if not standstills:
        speed = f': its lowest speed (mean over 1 s) is {slowest:.2f} m/s' * (slowest > 0)
        return [Reason(Code.NO_STANDSTILL, f'the vehicle is never at rest{speed}')]
    if starts and not any(abs(start - stop) < 1.0 for start in starts for _, stop in standstills):
        return [Reason(Code.NO_STANDSTILL, 'no standstill before the drive: the first is at '
                       f'{standstills[0][0]:.1f} s')]
    return []


def _leg_reasons(legs: list[dict[str, Any]], config: Config) -> list[Reason]:
    """Return the reasons for legs that are too short, or that end where they start."""
    short = [leg for leg in legs if leg['distance'] < config.leg.min_distance]
    loops = [leg for leg in legs if leg not in short and is_closed(leg)]
    reasons = []
    for affected, code, template in (
            (short, Code.LEG_TOO_SHORT, 'has a path length of {distance:.0f} m; the limit is '
             f'{config.leg.min_distance:g} m'),
            (loops, Code.CHORD_TOO_SHORT, 'is a loop: {chord:.0f} m from start to end, less than '
             'a fifth of the path length of {distance:.0f} m')):
        if affected:
            several = f'{len(affected)} of {len(legs)} legs; for example, ' * (len(affected) > 1)
            text = f'{several}the leg {{start:.1f}}:{{stop:.1f}} s {template}'
            reasons.append(Reason(code, text.format(**affected[0])))
    return reasons


def _heading_reasons(content: dict[str, Any], mapping: dict[str, str],
                     config: Config) -> list[Reason]:
    """Return the reason for a missing or poor heading, with possible sources."""
    if 'heading' in mapping or math.isfinite(config.alignment.heading):
        return []
    facts = next(t for t in content['topics'] if t['name'] == mapping['imu'])['imu']
    if not facts['orientation']:
        cause = 'no heading topic, and the IMU publishes no orientation'
    elif facts['yaw_sigma'] is None:
        cause = 'no heading topic, and the IMU orientation has no covariance'
    elif facts['yaw_sigma'] > config.verdict.max_yaw_sigma:
        cause = ('the only heading is the IMU orientation with an uncertainty of '
                 f'{math.degrees(facts["yaw_sigma"]):.1f} deg; the limit is '
                 f'{math.degrees(config.verdict.max_yaw_sigma):.2g} deg')
    else:
        return []
    return [Reason(Code.YAW_NOT_SEPARABLE, cause)]
