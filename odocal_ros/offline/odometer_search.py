# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Search for an odometer in messages of other types, such as those of a vehicle bus.

A number of a message is an odometer if it, or its integral, is proportional to the distance
between the fixes.
"""

from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import islice
import math
from numbers import Integral
import re
from typing import Any

import numpy as np

from odocal_ros.bagio.read import TopicInfo
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.errors import BadData, OdocalError, UndefinedType
from odocal_ros.library.topics import COMMANDS, GNSS, SYSTEM_TOPICS, without_estimates
from odocal_ros.messages.decode import Deserialize
from odocal_ros.messages.message_fields import IMU, MessageView, Pairs
from odocal_ros.messages.odometer_types import TYPES as ODOMETERS
from odocal_ros.nav.odometer import make_travel
from odocal_ros.offline.survey import FixPath, Match
from odocal_ros.offline.wheel_survey import find_sides, wheel_settings

# judgement: limits of the search in one topic; 0.4 million values take 1 s and 4 MB
MAX_MESSAGES, MAX_FIELDS, MAX_VALUES = 10_000, 128, 400_000
MAX_ELEMENTS = 16       # judgement: of an array
MAX_BYTES = 2**14       # judgement: of a message; images and point clouds are longer
# fields that are not searched: stamps, and positions, whose axis may grow with distance
NOT_SEARCHED = ('header', 'stamp', 'seq', 'pose', 'latitude', 'longitude', 'altitude')
INCREMENT_WORDS = ('delta', 'diff', 'increment', 'since')
ROLLOVERS = (2**8, 2**16, 2**32)      # format: of counters of 8, 16 and 32 bits
MAX_TOPICS = 20       # judgement: topics of unknown types that are searched
RECEIVER_WORDS = (*GNSS, 'navsat', 'nmea', 'ubx')      # topics of GNSS receivers
# types without an odometer: their fields have fixed meanings, or those of several raw CAN frames
OTHER_PACKAGES = ('geometry_msgs', 'nav_msgs', 'tf2_msgs', 'visualization_msgs',
                  'diagnostic_msgs', 'can_msgs')


class FieldCollector:
    """Collects all numbers in evenly selected messages of one topic, as a reader of a bag."""

    unreadable = 0       # an unreadable topic is no error

    def __init__(self, count: int) -> None:
        self.count, self.error, self.is_undefined = count, '', False
        self.paths: list[str] = []
        self.is_integer: list[bool] = []
        self._stride, self._message_count, self._times, self._values = 1, 0, array('q'), array('d')
        self._t_ns, self._travel = np.empty(0, np.int64), dict[str, Floats]()

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Store the numbers of every n-th message; return no samples."""
        k = -self._message_count % self._stride
        self._message_count += len(raws)
        while k < len(raws) and not self.error:      # the first message sets the stride
            self._store(raws[k], int(received_ns[k]), deserialize)
            k += self._stride
        return []

    def _store(self, raw: bytes, time_ns: int, deserialize: Deserialize) -> None:
        """Store the numbers of a message; one that differs from the first message is skipped."""
        try:
            view = MessageView(deserialize(raw) if len(raw) <= MAX_BYTES else None)
            if not self.paths:
                self._find_fields(view.message)
            values = [float(view.value(path)) for path in self.paths]
        except OdocalError as error:
            self.error, self.is_undefined = str(error), isinstance(error, UndefinedType)
        except MemoryError:
            raise
        except Exception:    # a damaged message, or one with a shorter list
            return
        else:
            self._times.append(time_ns)
            self._values.extend(values)

    def _find_fields(self, message: object) -> None:
        """Find the numeric fields of the first message; raise BadData if there are none."""
        numbers = list(islice(_numbers(message), MAX_FIELDS))
        if not numbers:
            raise BadData('no numeric field')
        self.paths = [path for path, _ in numbers]
        self.is_integer = [isinstance(value, Integral) for _, value in numbers]
        max_messages = min(MAX_MESSAGES, MAX_VALUES // len(numbers))
        self._stride = math.ceil(self.count / max_messages)

    def facts(self, path: FixPath) -> dict[str, Any]:
        """Return the number of fields, ``tried``, and those that follow the path, ``found``."""
        t_ns = np.array(self._times, np.int64)
        values = np.array(self._values).reshape(len(t_ns), len(self.paths))
        keep = np.append(True, np.diff(t_ns) > 0)[:len(t_ns)] & np.isfinite(values).all(axis=1)
        self._t_ns = t_ns[keep]
        fields = zip(self.paths, self.is_integer, values[keep].T, strict=True)
        matching = [match for name, is_integer, value in fields if (match := _best_meaning(
            name, is_integer, self._t_ns, value, path, self._stride)) is not None]
        self._travel = {field['path']: travel for field, travel in matching}
        return {'tried': len(self.paths), 'found': [
            field | {'settings': _settings(field, f'odometer.field={field["path"]}')}
            for field in sorted((field for field, _ in matching), key=_sort_key)]}

    def settings(self, fields: Sequence[dict[str, Any]],
                 turn_rate: tuple[Ints, Floats] | None) -> list[str]:
        """
        Return the settings for left and right wheels, or for the best field.

        fields : of ``facts``.   turn_rate : times, ns, and rate to the left, rad/s, if known.
        """
        best, t_ns = fields[0], self._t_ns
        scale_tolerance = 0.3  # judgement: relative difference between wheels of a vehicle
        wheels = [field for field in fields if all(
            field[key] == best[key] for key in ('quantity', 'wrap', 'is_integer'))
            and abs(field['scale'] / best['scale'] - 1) < scale_tolerance]
        if turn_rate is not None and 1 < len(wheels) <= len(WHEELS):
            s = np.stack([self._travel[field['path']] for field in wheels], -1)
            sides = find_sides((t_ns - t_ns[0]) * 1e-9, s, np.ones(len(wheels), bool),
                               ((turn_rate[0] - t_ns[0]) * 1e-9, turn_rate[1]))
            if options := wheel_settings([{'key': field['path'], 'side': side}
                                          for field, side in zip(wheels, sides, strict=True)]):
                return _settings(best, *options)
        return list(best['settings'])


def _settings(field: dict[str, Any], *names: str) -> list[str]:
    """Return the settings that name a field, then those for its meaning."""
    default = 'cumulative' if field['is_integer'] else 'rate'
    return [*names, *[f'odometer.quantity={field["quantity"]}'] * (field['quantity'] != default),
            *[f'odometer.wrap={field["wrap"]}'] * (field['wrap'] > 0),
            *['odometer.reversed=true'] * (field['scale'] < 0)]


def _sort_key(field: dict[str, Any]) -> tuple[bool, float]:
    """Return the sort key of a field, the best first: counters, then the explained variance."""
    return field['quantity'] != 'cumulative', -round(field['explained'], 3)


def _numbers(value: object, path: str = '') -> Iterator[tuple[str, Any]]:
    """Yield path and value of a number, or of each number of an array or a message."""
    if isinstance(value, (list, np.ndarray)):
        for k, element in enumerate(value[:MAX_ELEMENTS]):
            yield from _numbers(element, f'{path}[{k}]')
    elif isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        yield path, value
    for name in getattr(type(value), '__dataclass_fields__', ()):
        if not name.startswith('__') and name not in NOT_SEARCHED:
            yield from _numbers(getattr(value, name), f'{path}.{name}'.removeprefix('.'))


def _best_meaning(path: str, is_integer: bool, t_ns: Ints, value: Floats, fixes: FixPath,
                  stride: int) -> tuple[dict[str, Any], Floats] | None:
    """
    Return the meaning with which a field follows the path best, and its travel; None if none does.

    t_ns, value : (n,) arrival times and numbers of every stride-th message. The scale of the
    meaning is in m per unit, or m/s per unit for a rate.
    """
    matching: list[tuple[dict[str, Any], Floats]] = []
    seconds: Floats = np.multiply(t_ns - t_ns[:1], 1e-9)
    for quantity in _quantities(path):
        counts = is_integer and quantity == 'cumulative'
        wrap = _rollover(value) if counts else 0
        s = make_travel(seconds, value.astype(np.int64) if counts else value,
                        OdometerForm(quantity, wrap, ''))[0].s
        s = s * stride if quantity == 'increment' else s      # of messages in between
        match = fixes.match(t_ns, s)
        if match.follows:
            matching.append(({
                'path': path, 'is_integer': is_integer, 'quantity': quantity, 'wrap': wrap,
                'scale': match.scale, 'explained': match.explained}, s))
    return max(matching, key=lambda entry: entry[0]['explained'], default=None)


def _quantities(name: str) -> tuple[str, str]:
    """Return the possible meanings of a value, by its name."""
    per_message = any(word in name.lower() for word in INCREMENT_WORDS)
    return 'cumulative', 'increment' if per_message else 'rate'


def _rollover(value: Floats) -> int:
    """Return the modulus of a counter that rolls over, 0 if it does not."""
    return next((modulus for modulus in ROLLOVERS if len(value) > 1 and np.ptp(value) < modulus
                 and (np.abs(np.diff(value)) > modulus / 2).any()), 0)


def make_collectors(topics: Mapping[str, TopicInfo], known: Collection[str],
                    requested: Collection[str]) -> dict[str, FieldCollector]:
    """
    Return a collector for each topic whose fields could be an odometer.

    known : topics that have a reader.   requested : topics that the user named.
    """
    possible = [name for name, info in topics.items()
                if info.count and name not in known and _may_be_odometer(info)]
    usable = {*requested, *without_estimates(possible)}
    searched = [name for name, info in topics.items()
             if info.count and name not in known and name in usable]
    return {name: FieldCollector(topics[name].count) for name in searched[:MAX_TOPICS]}


def _may_be_odometer(info: TopicInfo) -> bool:
    """Return True for types without a fixed meaning, except GNSS and commands."""
    package = info.msgtype.partition('/')[0]
    return (info.msgtype not in (*ODOMETERS, IMU) and info.name not in SYSTEM_TOPICS
            and package not in OTHER_PACKAGES and '/calibrator/' not in info.name
            and not any(word.startswith((*RECEIVER_WORDS, *COMMANDS))
                        for word in re.split(r'[/_]', f'{info.name}/{info.msgtype}'.lower())))


def match_of(rows: OdometerSamples, form: OdometerForm, path: FixPath) -> Match:
    """Return the comparison of the travel of an odometer with the path of the fixes."""
    t_ns = rows.received_ns
    keep = (rows.value == rows.value) & (t_ns > 0)
    keep[1:] &= t_ns[1:] > t_ns[:-1]
    t_ns = t_ns[keep]
    s = make_travel((t_ns - t_ns[:1]) * 1e-9, rows.value[keep], form)[0].s
    return path.match(t_ns, s)


def form_by_fixes(info: TopicInfo, rows: OdometerSamples, form: OdometerForm,
                  path: FixPath) -> OdometerForm:
    """
    Return the form with which a topic of one plain number follows the path of the fixes.

    The one by its type, if that follows, if no other does, or if the type determines the meaning.
    """
    if not info.msgtype.startswith('std_msgs/') or match_of(rows, form, path).follows:
        return form
    others = (OdometerForm(quantity, 0, 'm/pulse') for quantity in _quantities(info.name)
              if quantity != form.quantity)
    return next((other for other in others if match_of(rows, other, path).follows), form)


def topics_not_following(matches: Mapping[str, Match]) -> set[str]:
    """Return the topics that do not follow the path of the fixes, if another one does."""
    if not any(match.follows for match in matches.values()):
        return set()
    return {topic for topic, match in matches.items() if not match.follows}


def drop_weak_fields(fields: Collection[dict[str, Any]]) -> None:
    """Remove fields that explain much less of the variance than the best of all topics."""
    best = max((field['explained'] for facts in fields for field in facts['found']), default=0.0)
    # removes all false signals of benchmarks/odometer_fields.py but energy with fixes of 2.5 m
    variance_factor, least = 3.0, 0.01
    for facts in fields:
        facts['found'] = [field for field in facts['found']
                          if 1 - field['explained'] <= variance_factor * (1 - best) + least]


def best_topic(fields: Mapping[str, dict[str, Any]], requested: str) -> str:
    """
    Return the topic whose field follows the path best, '' without one.

    fields : ``FieldCollector.facts`` by topic.   requested : the only possible topic, if set.
    """
    matching = [name for name, facts in fields.items() if facts['found'] and (
        not requested or name.strip('/') == requested.strip('/'))]
    return min(matching, default='', key=lambda name: _sort_key(fields[name]['found'][0]))
