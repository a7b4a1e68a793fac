# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Assignment of a bag's topics to inputs (slots), for replay."""

from collections.abc import Iterable, Mapping
import re

from odocal_ros.bagio.read import TopicInfo
from odocal_ros.data.inputs import EXTERNAL_SLOTS, INPUTS, topic_option
from odocal_ros.errors import BadTopics, BadUsage, similar_names
from odocal_ros.messages.decode import full_type
from odocal_ros.messages.message_fields import (
    FIX,
    GEODETIC,
    IMU,
    LOCAL_TYPES,
    TRANSFORMS,
    types_of,
)
from odocal_ros.messages.odometer_types import TYPES as ODOMETERS
from odocal_ros.safe_io.text_formats import indented_list, one_line
from odocal_ros.settings.config import Config, OdometerConfig, SIDES

SYSTEM_TOPICS = ('/rosout', '/parameter_events', '/tf', '/tf_static', '/clock', '/diagnostics')
COMMANDS = ('cmd', 'command', 'setpoint', 'target', 'desired')   # sent to a vehicle, not measured
GOALS = ('goal', 'initialpose', 'initial_pose', 'clicked')       # set by a person: Nav2 and RViz
# judgement: names of estimates by GNSS, INS, SLAM, cameras and filters, and of joints that do not
# drive; such a topic is no odometer if there is another one. Whole words, then parts of words
ESTIMATES = re.compile(
    '(?:^|[/_])(?:ins|nav|map|local|imu|vio|lio|dlio|dlo|icp|ndt|sbg|arm|reference|zed[0-9a-z]*|'
    'camera[0-9]*|t265|slam|rtabmap|novatel|oem7|vectornav|applanix|microstrain|xsens)(?=[/_]|$)|'
    'filtered|fused|ekf|estimat|gps|gnss|fix|global|ground_truth|localiz|mapping|kinematic_state|'
    'visual|lidar|laser|vins|steer')
# names of positions by a filter of the receiver or the robot, which include IMU and often wheels
FUSED_FIXES = re.compile('(?:^|[/_])(?:ins|ekf|ukf|filter|odometry)(?=[/_]|$)|filtered|fused')
GNSS = ('gps', 'gnss', 'fix', 'ublox', 'novatel', 'septentrio')

NO_MESSAGES_REMEDY = 'Check the driver and the QoS of the recorder, then record again.'
# types of a position reference. An Odometry is one only if the user names it: most are the wheel
# odometry itself
REFERENCES = (*GEODETIC, *(kind for kind in LOCAL_TYPES if kind not in ODOMETERS))
# slots in the order of choice; the others are chosen from the remaining topics
CHOSEN_FIRST = ('odometer_right', 'odometer', 'heading')

Topics = dict[str, TopicInfo]


def choose_topics(topics: Topics, config: Config, overrides: dict[str, str],
                  has_marks: bool = False) -> dict[str, str]:
    """
    Return slot -> topic.

    topics : by name.   config : required inputs, and the type of the odometer.   overrides :
    slot -> topic, by the user.   has_marks : marks on surveyed points replace fixes.

    Raises BadUsage: a named topic is missing, or a required input is not unique: none or several
    fit. All such inputs are named at once, with the option that selects each. BadTopics lists
    topics.
    """
    mapping = {slot: resolve_topic(topics, slot, topic) for slot, topic in overrides.items()}
    _check_reference(mapping)
    if has_marks and 'fix' in mapping:
        raise BadUsage(f'--fix-topic {mapping["fix"]}: reference.marks is set, so fixes '
                       'are not used; omit --fix-topic or reference.marks')
    errors: list[str] = []
    for slot in required_slots(config, has_marks):
        if slot in mapping:
            continue
        names = candidates(topics, slot, config, mapping)
        if len(names) == 1:
            mapping[slot] = names[0]
        elif not _is_optional(slot, config, names):
            errors.append(_missing_topic_text(topics, slot, names, config, mapping))
    if errors:
        if not all('; choose one with ' in text for text in errors):
            errors.append(f'the bag has:{_describe_topics(topics, topics)}')
        raise BadTopics(';\n'.join(errors))
    return mapping


def required_slots(config: Config, has_marks: bool = False) -> tuple[str, ...]:
    """Return the slots to fill, in order."""
    reference = config.reference
    has_surveyed_ends = (reference.start and reference.end) or reference.marks or has_marks
    slots = [slot for slot in config.inputs if not (slot == 'fix' and has_surveyed_ends)]
    return (*(slot for slot in CHOSEN_FIRST if slot in slots),
            *(slot for slot in slots if slot not in CHOSEN_FIRST))


def candidates(topics: Topics, slot: str, config: Config, mapping: dict[str, str]) -> list[str]:
    """Return the topics that fit a slot and are not chosen for another."""
    types = _types(slot, config)
    used_topics = set(mapping.values())
    names = [topic.name for topic in topics.values()
             if topic.count and topic.msgtype in types and topic.name not in used_topics
             and topic.name not in SYSTEM_TOPICS and '/calibrator/' not in topic.name]
    if slot in ('odometer', 'odometer_right'):
        names = without_estimates([name for name in names if not _contains(name, COMMANDS)])
        if config.odometer.has_two_topics:
            names = [name for name in names if ('right' in name) == (slot != 'odometer')]
    elif slot == 'heading':
        if config.alignment.heading_source == 'auto':    # by the name of the node's input
            return [name for name in names if _base_name(name) == 'heading']
        # a single topic with an orientation is the IMU
        is_imu = len(names) == 1 and 'imu' not in mapping
        names = [name for name in names if 'heading' in name] or ([] if is_imu else names)
    elif slot == 'imu':
        names = _prefer_without(names, ('heading',))
    elif slot == 'fix':
        fixes = [name for name in names if topics[name].msgtype in GEODETIC]
        names = [name for name in fixes if topics[name].msgtype == FIX] or fixes or [
            name for name in names if not _contains(name, (*COMMANDS, *GOALS))]
        names = [name for name in names if not FUSED_FIXES.search(name.lower())] or names
    elif slot == 'fix_velocity':
        names = [name for name in names if _is_of_receiver(name)]
        # by the name of the node's input
        names = [name for name in names if _base_name(name) == slot] or names
    return names


def without_estimates(names: list[str]) -> list[str]:
    """Return the topics whose name is not that of an estimate; all, if none are left."""
    return [name for name in names if not is_estimate(name)] or names


def is_estimate(name: str) -> bool:
    """Return True if the name of a topic is that of an estimate, not of wheels."""
    return ESTIMATES.search(name.lower()) is not None


def _check_reference(mapping: dict[str, str]) -> None:
    """Raise BadUsage if one topic is both odometer and reference: its scale would be 1."""
    for slot in ('odometer', 'odometer_right'):
        if 'fix' in mapping and mapping.get(slot) == mapping['fix']:
            raise BadUsage(f'{mapping["fix"]} is both {topic_option(slot)} and '
                           f'{topic_option("fix")}: an odometer cannot be calibrated against '
                           'itself; name another topic for one of them')


def reference_note(topics: Topics, mapping: dict[str, str], overrides: dict[str, str]) -> str:
    """Return the note that poses are the reference if the user did not name them, or ''."""
    fix = mapping.get('fix', '')
    if not fix or 'fix' in overrides or topics[fix].msgtype in GEODETIC:
        return ''
    return (f'no NavSatFix with messages in the bag; position reference: {fix} '
            f'({topics[fix].msgtype}); another one: {topic_option("fix")}')


def _is_optional(slot: str, config: Config, names: list[str]) -> bool:
    """Return True if a leg does not need a slot; names : topics that fit it, none or several."""
    if slot == 'imu':
        return not names and not config.odometer.needs_imu
    return slot in EXTERNAL_SLOTS and not (
        slot == 'heading' and config.alignment.heading_source == 'heading_topic')


def _is_of_receiver(name: str) -> bool:
    """Return True if the name of a topic has a receiver word and no word of another source."""
    return (any(word.startswith(GNSS) for word in re.split('[/_]', name.lower()))
            and not _contains(name, (*COMMANDS, 'filtered', 'fused', 'ekf', 'odom', 'wheel',
                                     'speed')))


def _types(slot: str, config: Config) -> Iterable[str]:
    """Return the message types that fit a slot."""
    if slot == 'fix':
        return REFERENCES
    return tuple(map(full_type, types_of(slot, config.odometer))) or ODOMETERS


def resolve_topic(topics: Topics, slot: str, topic: str) -> str:
    """Return the name in the bag of a topic that the user named; raise BadUsage if unusable."""
    name = next((name for name in (topic, f'/{topic}') if name in topics), '')
    if not name:
        similar = similar_names(topic, topics)
        problem = 'no such topic' + (f' (did you mean {similar[0]}?)' if similar else '')
    elif not topics[name].count:
        problem = 'the topic has no message'
    elif not _fits_slot(topics[name].msgtype, slot):
        problem = (f'the topic is of {topics[name].msgtype}, which cannot be used as '
                   f'{INPUTS[slot].label}')
    else:
        return name
    raise BadTopics(f'{topic_option(slot)} {one_line(topic)}: {problem}; the bag has:'
                    f'{_describe_topics(topics, topics)}')


def topics_without_messages(types: Mapping[str, tuple[str, int]], slot: str) -> list[str]:
    """Return the topics of a slot's type without messages; types : topic -> (type, count)."""
    msgtype = {'imu': IMU, 'fix': FIX}.get(slot)      # other types have more uses than one
    return [name for name, (found_type, count) in types.items()
            if found_type == msgtype and not count]


def _fits_slot(msgtype: str, slot: str) -> bool:
    """Return True if a type fits a slot; an odometer can have any other type."""
    if slot in ('odometer', 'odometer_right'):
        return full_type(msgtype) not in (IMU, *GEODETIC)
    return full_type(msgtype) in types_of(slot, OdometerConfig())


def _missing_topic_text(topics: Topics, slot: str, names: list[str], config: Config,
                        mapping: dict[str, str]) -> str:
    """Return the reason why not one topic fits a slot, and its option; names : that fit it."""
    fix = mapping.get('fix', '')
    if slot == 'odometer' and fix and not names and topics[fix].msgtype in ODOMETERS:
        return (f'no odometer in the bag besides {fix}, which is the position reference '
                f'({topic_option("fix")}): an odometer cannot be calibrated against itself')
    if names:
        has_sides = all(any(side in name for name in names) for side in SIDES)
        hint = (', or for two wheels set odometer.left and odometer.right to topic'
                if slot == 'odometer' and has_sides else '')
        return (f'{len(names)} topics can be the {INPUTS[slot].label}; choose one with '
                f'{topic_option(slot)}{hint}:{_describe_topics(topics, names)}')
    types = tuple(_types(slot, config))
    empty = topics_without_messages({t.name: (t.msgtype, t.count) for t in topics.values()}, slot)
    if empty:
        return f'no {INPUTS[slot].label}: {", ".join(empty)} has no messages in the bag'
    if slot == 'fix':
        return (f'no {INPUTS[slot].label} (a topic of {", ".join(types[:-1])} or {types[-1]}) in '
                f'the bag; name a {TRANSFORMS} or nav_msgs/msg/Odometry with {topic_option(slot)}')
    allowed = ' or '.join(types) if len(types) < 3 else 'counts, angles or speeds'
    others = ', '.join(topic for topic in mapping.values() if topics[topic].msgtype in types)
    others = 'the IMU' if slot == 'heading' else others
    besides = f' besides {others}' if others else ''
    return f'no {INPUTS[slot].label} (a topic of {allowed}{besides}) in the bag'


def _describe_topics(topics: Topics, names: Iterable[str]) -> str:
    """Return the topics that have messages, with their types, as a list."""
    return indented_list([f'{name} ({topics[name].msgtype})' for name in names
                          if topics[name].count and name not in SYSTEM_TOPICS]
                         or ['no topic with messages'])


def _base_name(name: str) -> str:
    """Return the last part of a topic's name."""
    return name.rstrip('/').rpartition('/')[2]


def _contains(name: str, words: Iterable[str]) -> bool:
    """Return True if the name of a topic contains one of some words."""
    return any(word in name.lower() for word in words)


def _prefer_without(fitting: list[str], words: Iterable[str]) -> list[str]:
    """Return the topics without such a word in their name; all, if none are left."""
    return [name for name in fitting if not _contains(name, words)] or fitting
