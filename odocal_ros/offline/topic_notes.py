# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Notes of odocal inspect and try on selected topics, and on topics that cannot be read."""

from collections.abc import Collection, Mapping
from itertools import product
from typing import Any

from odocal_ros.library.topics import is_estimate

MAX_NAMES = 6      # judgement: topics in a note
CONVERT = ("convert the bag to mcap with 'ros2 bag convert' where these packages are installed "
           '(docs/from_a_bag.md)')
RAW_CAN, ODOMETRY = 'can_msgs/msg/Frame', 'nav_msgs/msg/Odometry'
Quantities = Mapping[str, tuple[bool, bool]]     # IMU topic -> has turn rates, has specific forces


def partial_imus(quantities: Quantities) -> set[str]:
    """Return IMU topics without turn rates or specific forces that another topic has."""
    best = max(quantities.values(), default=(False, False))
    return {topic for topic, measured in quantities.items() if measured < best}


def topic_notes(mapping: Mapping[str, str], requested: Collection[str], quantities: Quantities,
                undefined: Mapping[str, str]) -> list[str]:
    """
    Return notes on the selected topics.

    mapping : slot -> topic.   requested : slots that the user assigned.   undefined : topic ->
    type of messages that cannot be read without a definition.
    """
    notes, odometer, imu = [], mapping.get('odometer', ''), mapping.get('imu', '')
    if odometer and 'odometer' not in requested and is_estimate(odometer):
        notes.append(f'{odometer} is an estimate by its name (GNSS, SLAM or a filter): its scale '
                     'is not that of the wheels. Name the topic of the wheels with '
                     '--odometer-topic')
        if undefined:
            notes.append(undefined_text(undefined) + f'. If one is the odometer, {CONVERT}')
    gyros, accelerometers = (
        [topic for topic, measured in quantities.items() if measured == which]
        for which in ((True, False), (False, True)))
    notes += [f'{gyro} has only turn rates, {accelerometer} only specific forces: publish both in '
              'one topic (RealSense: unite_imu_method:=2)'
              for gyro, accelerometer in product(gyros[:1], accelerometers[:1]) if imu in (
                  gyro, accelerometer)]
    return notes


def undefined_text(undefined: Mapping[str, str]) -> str:
    """Return a sentence on topics that were not searched for an odometer; topic -> type."""
    names = [f'{topic} ({msgtype})' for topic, msgtype in undefined.items()]
    more = f' and {len(names) - MAX_NAMES} more' * (len(names) > MAX_NAMES)
    return ('not searched for an odometer, because the bag does not define their types: '
            + ', '.join(names[:MAX_NAMES]) + more)


def missing_input_texts(slot: str, content: Mapping[str, Any],
                        mapping: Mapping[str, str]) -> tuple[str, str]:
    """Return the text on what a bag has in place of an input, and the action; '' if nothing."""
    if slot == 'odometer':
        return _odometer_texts(content)
    poses = [topic['name'] for topic in content['topics'] if topic['type'] == ODOMETRY
             and topic['count'] and topic['name'] != mapping.get('odometer')]
    if slot != 'fix' or not poses:
        return '', ''
    return (f'; {", ".join(poses[:MAX_NAMES])}: poses of nav_msgs/Odometry',
            f'If their positions do not contain the odometer, add --fix-topic {poses[0]}. ')


def _odometer_texts(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return the text on unreadable topics of a bag without odometer, and the action, or ''."""
    undefined = content['undefined']
    frames = [topic['name'] for topic in content['topics'] if topic['type'] == RAW_CAN]
    cause, action = '', ''
    if undefined:
        cause += f'; {undefined_text(undefined)}'
        action += f'If one of them is the odometer, {CONVERT}. '
    if frames:
        cause += f'; {", ".join(frames)}: raw CAN frames'
        action += ('Decode the wheel speeds of the CAN frames into a topic, with the DBC file of '
                   'the vehicle. ')
    return cause, action
