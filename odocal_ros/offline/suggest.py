# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Choice of the most likely topic for each input of a bag, for odocal inspect and try."""

from collections.abc import Collection, Iterable

from odocal_ros.bagio.read import TopicInfo
from odocal_ros.data.inputs import topic_option
from odocal_ros.errors import BadUsage
from odocal_ros.library.topics import candidates, choose_topics, required_slots, resolve_topic
from odocal_ros.messages.message_fields import GEODETIC
from odocal_ros.safe_io.text_formats import for_shell
from odocal_ros.settings.config import Config, with_settings

# judgement: words in topics of wheels and their electronics, preferred to any odometry
WHEEL_WORDS = ('pulse', 'tick', 'encoder', 'wheel', 'count', 'chassis', 'controller', 'vehicle',
               '/can', 'obd')
# judgement: words in topics of IMUs inside other sensors
OTHER_DEVICE_WORDS = ('zed', 'camera', 'realsense', 'd435', 'd455', 't265', '/oak', 'stereo',
                      'lidar', 'livox', 'ouster', 'os_cloud', 'hesai', 'velodyne')


def likely_mapping(topics: dict[str, TopicInfo], config: Config, overrides: dict[str, str],
                   unsuitable: Collection[str] = ()) -> tuple[dict[str, str], Config]:
    """
    Return slot -> most likely topic, and the settings that this mapping needs.

    unsuitable : odometer topics that do not follow the path of the fixes, while another does, and
    IMU topics without the turn rates or accelerations that another has.
    """
    mapping = {slot: resolve_topic(topics, slot, topic) for slot, topic in overrides.items()}
    if not config.odometer.wheel_keys and not {'odometer', 'odometer_right'} & mapping.keys() and (
            pair := _left_right_pair(topics, [
                topic for topic in candidates(topics, 'odometer', config, mapping)
                if topic not in unsuitable])):      # each wheel has its own topic
        config = with_settings(config, {'odometer.left': 'topic', 'odometer.right': 'topic'})
        mapping['odometer'], mapping['odometer_right'] = pair
    for slot in required_slots(config):
        fitting = [] if slot in mapping else candidates(topics, slot, config, mapping)
        if fitting:
            mapping[slot] = _sorted_topics(topics, slot, fitting, unsuitable)[0]
    return mapping, config


def _left_right_pair(topics: dict[str, TopicInfo], names: list[str]) -> tuple[str, str] | None:
    """Return the only topics of a left and a right wheel, whose names differ in this word only."""
    pairs = [(left, right) for left in names if 'left' in left
             and (right := left.replace('left', 'right')) in names
             and topics[left].msgtype == topics[right].msgtype]
    return pairs[0] if len(pairs) == 1 else None


def _sort_keys(slot: str, info: TopicInfo, unsuitable: Collection[str]) -> dict[str, int | str]:
    """Return reason -> sort key of a topic, the most important first; the smallest is best."""
    usual_name = {'imu': 'imu/data', 'fix': '/fix', 'odometer': '/odometer'}.get(slot, slot)
    name, kind = info.name.lower(), 0
    needed = ('it grows with the distance between the fixes' if 'odometer' in slot
              else 'it has turn rates')
    fits = int('rtk' in name if slot == 'fix'
               else not any(word in name for word in OTHER_DEVICE_WORDS))
    if 'odometer' in slot:
        fits = 2 * any(word in name for word in WHEEL_WORDS) or 'odom' in name
        kind = next(i for i, part in enumerate(('Int', 'JointState', '')) if part in info.msgtype)
    is_usual = info.name.endswith(usual_name) and bool(fits or slot != 'imu')
    return {needed: info.name in unsuitable,
            'counts are preferred to joint angles, and angles to speeds': kind,
            'it has the usual name': not is_usual, 'its name fits': -fits,
            'it has the most messages': -info.count, 'it is the first by name': info.name}


def _sorted_topics(topics: dict[str, TopicInfo], slot: str, names: Iterable[str],
                  unsuitable: Collection[str]) -> list[str]:
    """Return topics that fit a slot, the most likely first."""
    return sorted(names, key=lambda name: tuple(
        _sort_keys(slot, topics[name], unsuitable).values()))


def other_candidates(topics: dict[str, TopicInfo], slot: str, config: Config,
                     mapping: dict[str, str],
                     unsuitable: Collection[str]) -> tuple[list[str], str]:
    """Return the other candidates for a slot, the most likely first, and why it has its topic."""
    used_topics = {other: topic for other, topic in mapping.items() if other != slot}
    others = _sorted_topics(topics, slot, set(candidates(topics, slot, config, used_topics)) - {
        mapping[slot]}, unsuitable)
    keys, *other_keys = (_sort_keys(slot, topics[name], unsuitable)
                         for name in (mapping[slot], *others[:1]))
    return others, next((reason for reason, key in keys.items()
                         if other_keys and key != other_keys[0][reason]), '')


def replay_refusal(topics: dict[str, TopicInfo], config: Config, overrides: dict[str, str]) -> str:
    """Return the error of replay if it needs more topic options than overrides; '' if none."""
    try:
        choose_topics(topics, config, overrides)
    except BadUsage as error:
        return str(error)
    return ''


def replay_command(path: str, topics: dict[str, TopicInfo], config: Config,
                   overrides: dict[str, str], mapping: dict[str, str], extra: list[str]) -> str:
    """
    Return the suggested replay command; '' if an input is missing.

    extra : settings, KEY=VALUE, and options, --OPTION VALUE.
    """
    needed = {'odometer', 'fix'} | ({'imu'} if config.odometer.needs_imu else set())
    if not needed <= mapping.keys():
        return ''
    words = ['odocal', 'replay', path]
    for slot, topic in mapping.items():
        others = {other: name for other, name in mapping.items() if other != slot}
        fitting = candidates(topics, slot, config, others)
        local = slot == 'fix' and topics[topic].msgtype not in GEODETIC  # stated, as it is unusual
        if slot in overrides or len(fitting) > 1 or topic not in fitting or local:
            words += [topic_option(slot), topic]
    if 'odometer_right' in mapping and 'odometer_right' not in overrides:
        extra = ['odometer.left=topic', 'odometer.right=topic', *extra]
    for option in extra:
        words += option.split(' ', 1) if option.startswith('--') else ['--set', option]
    return for_shell(words)
