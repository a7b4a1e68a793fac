# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Findings of odocal inspect: inputs, standstills, speed or a heading that a calibration lacks."""

import math
from typing import Any

from odocal_ros.calib.drive import speed_reason
from odocal_ros.library.topics import NO_MESSAGES_REMEDY, topics_without_messages
from odocal_ros.offline.inspection_drive import is_closed
from odocal_ros.offline.topic_notes import missing_input_texts
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config

# reasons that affect the two-point method only: its initial alignment and its end points
TWO_POINT_CODES = {Code.NO_STANDSTILL, Code.CHORD_TOO_SHORT, Code.YAW_NOT_SEPARABLE,
                   Code.LEG_NOT_STRAIGHT}


# slot: code, name and action if it has no topic
MISSING = {
    'imu': (Code.NO_IMU, 'IMU', 'Record sensor_msgs/Imu, or name the topic with --imu-topic.'),
    'odometer': (Code.NO_ODOMETER, 'odometer', 'Record pulses, joint angles or a speed of the '
                 'wheels, or name the topic with --odometer-topic.'),
    'fix': (Code.NO_FIX, 'fixes', 'Record sensor_msgs/NavSatFix, or name a topic of positions '
            'with --fix-topic.')}


def finding_facts(findings: list[Reason], config: Config,
                  options: list[str]) -> list[dict[str, Any]]:
    """Return findings as dicts; ``method``: the only one that a finding affects, None: all."""
    has_wheels = config.odometer.wheel_keys or any(
        option.startswith(('odometer.left=', 'odometer.wheels=')) for option in options)
    codes = TWO_POINT_CODES - {Code.NO_STANDSTILL} if has_wheels else TWO_POINT_CODES
    return [reason.as_dict() | {'method': 'two_point' if (
        config.method != 'two_point' and reason.code in codes) else None}
        for reason in dict.fromkeys(findings)]


def missing_input_reasons(content: dict[str, Any], mapping: dict[str, str],
                          config: Config) -> list[Reason]:
    """Return the reasons for missing or unusable inputs, and for a drive that lacks something."""
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
    for slot, (code, label, remedy) in MISSING.items():
        facts = topics.get(mapping.get(slot, ''), {})
        if not facts and (slot != 'imu' or config.odometer.needs_imu):
            empty = topics_without_messages(
                {name: (topic['type'], topic['count']) for name, topic in topics.items()}, slot)
            cause, action = missing_input_texts(slot, content, mapping)
            reasons.append(Reason(
                code, f'{", ".join(empty)} has no messages', NO_MESSAGES_REMEDY) if empty else
                Reason(code, f'no topic for the {label}{cause}', action + remedy))
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
    short_legs = [leg for leg in legs if leg['distance'] < config.leg.min_distance]
    loops = [leg for leg in legs if leg not in short_legs and is_closed(leg)]
    reasons = []
    for affected, code, template in (
            (short_legs, Code.LEG_TOO_SHORT, 'has a path length of {distance:.0f} m; the limit is '
             f'{config.leg.min_distance:g} m'),
            (loops, Code.CHORD_TOO_SHORT, 'is a loop: {chord:.0f} m from start to end, less than '
             'a fifth of the path length of {distance:.0f} m')):
        if affected:
            count = f'{len(affected)} of {len(legs)} legs; for example, ' * (len(affected) > 1)
            text = f'{count}the leg {{start:.1f}}:{{stop:.1f}} s {template}'
            reasons.append(Reason(code, text.format(**affected[0])))
    return reasons


def _heading_reasons(content: dict[str, Any], mapping: dict[str, str],
                     config: Config) -> list[Reason]:
    """Return the reason for a missing or poor heading, with possible sources."""
    if 'heading' in mapping or math.isfinite(config.alignment.heading):
        return []
    facts = next(topic for topic in content['topics'] if topic['name'] == mapping['imu'])['imu']
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
