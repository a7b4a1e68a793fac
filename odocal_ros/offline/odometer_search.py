# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Search for the odometer of a bag: topics of unknown types, and topics that do not move."""

from collections.abc import Collection, Mapping, Sequence
import re
from typing import Any

from odocal_ros.bagio.read import TopicInfo
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.library.topics import COMMANDS, FUSED, GNSS, NEVER
from odocal_ros.messages.odometer_types import TYPES as ODOMETERS
from odocal_ros.messages.sensor_types import IMU
from odocal_ros.nav.odometer import travel
from odocal_ros.offline.field_survey import Fields, rank
from odocal_ros.offline.fix_path import FixPath, Match
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.config_file import parse_set

MOST_TOPICS = 20       # judgement: topics of unknown types that are searched
RECEIVER = (*GNSS, 'navsat', 'nmea', 'ubx')
STANDARD = ('geometry_msgs', 'nav_msgs', 'tf2_msgs', 'visualization_msgs', 'diagnostic_msgs')


def searched(topics: Mapping[str, TopicInfo], known: Collection[str],
             asked: Collection[str]) -> dict[str, Fields]:
    """
    Return a collector for each topic whose fields could be an odometer.

    known : topics that have a reader.   asked : topics that the user named.
    """
    found = [name for name, info in topics.items() if info.count and name not in known and (
        name in asked or _possible(info))]
    return {name: Fields(topics[name].count) for name in found[:MOST_TOPICS]}


def _possible(info: TopicInfo) -> bool:
    """Return True for types without a meaning of their own, not of GNSS and not commands."""
    package = info.msgtype.partition('/')[0]
    words = re.split(r'[/_]', f'{info.name}/{info.msgtype}'.lower())
    return (info.msgtype not in (*ODOMETERS, IMU) and info.name not in NEVER
            and package not in STANDARD and '/calibrator/' not in info.name
            and not any(word.startswith((*RECEIVER, *COMMANDS)) or word in FUSED
                        for word in words))


def match_of(rows: OdometerSamples, form: OdometerForm, path: FixPath) -> Match:
    """Return the comparison of the travel of an odometer with the path of the fixes."""
    t_ns = rows.received_ns
    keep = (rows.value == rows.value) & (t_ns > 0)
    keep[1:] &= t_ns[1:] > t_ns[:-1]
    t_ns = t_ns[keep]
    s = travel((t_ns - t_ns[:1]) * 1e-9, rows.value[keep], form)[0].s
    return path.match(t_ns, s)


def still(matches: Mapping[str, Match]) -> set[str]:
    """Return the topics that do not follow the path of the fixes, if another one does."""
    if not any(match.follows for match in matches.values()):
        return set()
    return {topic for topic, match in matches.items() if not match.follows}


def only_near_best(fields: Sequence[dict[str, Any]]) -> None:
    """Remove fields that leave much more of the variance than the best of all topics."""
    best = max((one['explained'] for facts in fields for one in facts['found']), default=0.0)
    # removes all false signals of benchmarks/odometer_fields.py but energy with fixes of 2.5 m
    more, least = 3.0, 0.01
    for facts in fields:
        facts['found'] = [one for one in facts['found']
                          if 1 - one['explained'] <= more * (1 - best) + least]


def best_topic(topics: Sequence[dict[str, Any]], asked: str) -> dict[str, Any] | None:
    """Return the topic whose field follows the path best, of the one asked for; None if none."""
    found = [facts for facts in topics if facts.get('fields', {}).get('found') and (
        not asked or facts['name'].strip('/') == asked.strip('/'))]
    return min(found, default=None, key=lambda facts: rank(facts['fields']['found'][0]))


def configured(config: Config, settings: Collection[str]) -> Config:
    """Return a configuration with settings as for --set."""
    return with_settings(config, dict(parse_set(setting) for setting in settings))
