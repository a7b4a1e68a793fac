# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read a bag and return the content of ``odocal inspect`` as plain values."""

from collections.abc import Sequence
from datetime import datetime, UTC
from typing import Any

import numpy as np

from odocal_ros.bagio.read import Bag, TopicInfo
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.pieces import medians
from odocal_ros.data.samples import OdometerForm, take
from odocal_ros.errors import OdocalError
from odocal_ros.library.topics import REFERENCES
from odocal_ros.messages import cdr
from odocal_ros.messages.decode import Deserialize, make_reader, Reader
from odocal_ros.messages.message_fields import IMU, Pairs
from odocal_ros.messages.odometer_types import TYPES as ODOMETERS
from odocal_ros.messages.transforms import add_static_readers
from odocal_ros.offline import odometer_search, survey, wheel_survey
from odocal_ros.offline.inspection_drive import lacking, look
from odocal_ros.offline.suggest import command, left_open, likely_mapping
from odocal_ros.offline.survey import fix_path, FixPath, Match
from odocal_ros.output.figures import counted
from odocal_ros.output.files import plain
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.glitches import is_impossible
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.settings.config import Config, SIDES, with_settings
from odocal_ros.settings.config_file import parse_set

# they affect only methods with an initial alignment, or with the end points alone
ENDS = {Code.NO_STANDSTILL, Code.CHORD_TOO_SHORT, Code.YAW_NOT_SEPARABLE, Code.LEG_NOT_STRAIGHT}


class _Tap:
    """Stores the samples of one reader; an error of reading is stored in ``trouble``."""

    unreadable = 0      # so that one bad topic does not end the reading of the others

    def __init__(self, reader: Reader) -> None:
        self.reader, self.recorder, self.trouble = reader, LegRecorder(), ''
        listed = reader.msgtype in wheel_survey.FIELDS
        self.values = wheel_survey.Values(reader.msgtype) if listed else None
        self.meaning: OdometerForm | None = None

    @property
    def form(self) -> OdometerForm | None:
        """Return the meaning of odometer values: by the fixes if found, else by the type."""
        return self.meaning or self.reader.form

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Read and keep a block."""
        if self.values:
            self.values.rows(raws, received_ns)
        try:
            for slot, block in self.reader.rows(raws, received_ns, deserialize):
                self.recorder.feed(slot, block)
        except OdocalError as error:
            self.trouble = str(error)
        return []


def inspect(bag: Bag, path: str, config: Config, overrides: dict[str, str]) -> dict[str, Any]:
    """
    Return the content of a bag, as for ``odocal inspect --json``.

    Times are seconds from the bag's first message, angles rad, the rest SI.
    """
    taps, refused = _taps(bag, config, overrides)
    search = odometer_search.searched(bag.topics, taps, overrides.values())
    bag.read({**taps, **search, **_static(taps, bag)}, print)       # a tap returns no rows
    mapping, config = likely_mapping(bag.topics, config, overrides)
    turn = _turn(taps[mapping['imu']]) if mapping.get('imu') in taps else None
    fixes = fix_path(taps[mapping['fix']].recorder.rows('fix'), config.gnss) if mapping.get(
        'fix') in taps else None
    lists = {name: tap.values.facts(turn, fixes) for name, tap in taps.items() if tap.values}
    if fixes and config.odometer.quantity == 'auto':
        _set_meanings(bag, taps, lists, fixes)
    matches = _matches(taps, lists, fixes) if fixes else {}
    idle = odometer_search.still(matches)
    none_follows = 'odometer' not in overrides and matches and not any(
        match.follows for match in matches.values())
    mapping, config = likely_mapping(bag.topics, config, overrides, idle)
    topics = [_topic(bag, info, taps.get(name), refused.get(name, ''))
              for name, info in bag.topics.items()]
    found: dict[str, Any] = {
        'bag': bag.name, 'path': path, 'files': [str(f) for f in bag.files],
        'start': bag.start_ns * 1e-9, 'duration': (bag.end_ns - bag.start_ns) * 1e-9,
        'start_utc': datetime.fromtimestamp(bag.start_ns // 10**9, UTC).isoformat(),
        'messages': sum(info.count for info in bag.topics.values()),
        'notes': [note for note in bag.notes if isinstance(note, str)],
        'topics': topics, 'mapping': mapping, 'still': sorted(idle),
        'mounting': None, 'drive': None,
        'standstills': [], 'legs': [], 'each_stop': [], 'straight': []}
    findings: list[Reason] = [note for note in bag.notes if isinstance(note, Reason)]
    for facts in topics:
        if 'odometer' in facts:
            facts['odometer']['still'] = facts['name'] in idle
        if fixes and (tried := search.get(facts['name'])) and not tried.trouble:
            facts['fields'] = tried.facts(fixes)
    odometer_search.only_near_best([facts['fields'] for facts in topics if 'fields' in facts])
    own = config
    if (mapping.get('odometer') not in taps or none_follows) and (
            best := odometer_search.best_topic(topics, overrides.get('odometer', ''))):
        mapping.pop('odometer_right', None)
        mapping['odometer'] = best['name']
        extra = search[best['name']].settings(best['fields']['found'], turn)
    else:
        extra = _wheels(taps, mapping, config, topics, lists)
        if (tap := taps.get(mapping.get('odometer', ''))) and tap.meaning:
            extra.append(f'odometer.quantity={tap.meaning.quantity}')
    if extra:
        config = with_settings(config, dict(map(parse_set, extra)))
        _read_again(bag, taps, mapping['odometer'], config, topics)
    if {'imu', 'odometer'} <= mapping.keys():
        extra += look(bag, _together(taps, mapping), config, found, findings)
    if 'fix' in mapping:
        config = settings_by_frame(taps[mapping['fix']].recorder.rows('fix'), config)
    findings += lacking(found, mapping, config)
    wheels = config.odometer.keys or any(
        option.startswith(('odometer.left=', 'odometer.wheels=')) for option in extra)
    ends = ENDS - {Code.NO_STANDSTILL} if wheels else ENDS
    found['findings'] = [reason.as_dict() | {'only': 'two_point' if (
        config.method != 'two_point' and reason.code in ends) else None}
        for reason in dict.fromkeys(findings)]
    found['open'] = left_open(bag.topics, own, overrides)
    found['command'] = command(path, bag.topics, own, overrides, mapping, extra)
    content: dict[str, Any] = plain(found)
    return content


def _taps(bag: Bag, config: Config,
          overrides: dict[str, str]) -> tuple[dict[str, _Tap], dict[Any, Any]]:
    """Return topic -> tap of every possible input, and topic -> error of unreadable ones."""
    asked = {topic: slot for slot, topic in overrides.items()}
    taps: dict[str, _Tap] = {}
    refused: dict[str, str] = {}
    for name, info in bag.topics.items():
        slot = asked.get(name) or ('imu' if info.msgtype == IMU else '') or (
            'fix' if info.msgtype in REFERENCES else '') or (
            'odometer' if info.msgtype in (*ODOMETERS, config.odometer.type) else '')
        if not slot or not info.count:
            continue
        slot = 'odometer' if slot == 'odometer_right' else slot
        try:
            taps[name] = _Tap(make_reader(slot, info.msgtype, config))
        except OdocalError as error:
            refused[name] = str(error)
    return taps, refused


def _static(taps: dict[str, _Tap], bag: Bag) -> dict[str, _Tap]:
    """Return the taps of static transforms; they share the recorder of their TF topic."""
    found = {}
    readers = {name: tap.reader for name, tap in taps.items()}
    for name, reader in add_static_readers(readers, bag.topics).items():
        if name in taps:
            tap = taps[name]
        else:
            found[name] = _Tap(reader)
            found[name].recorder = tap.recorder
    return found


def _topic(bag: Bag, info: TopicInfo, tap: _Tap | None, trouble: str) -> dict[str, Any]:
    seconds = (bag.end_ns - bag.start_ns) * 1e-9
    facts: dict[str, Any] = {'name': info.name, 'type': info.msgtype, 'count': info.count,
                             'rate_hz': survey.rate_of(info.count, seconds)}
    if tap is None:
        return facts | ({'trouble': trouble} if trouble else {})
    slot = tap.reader.slot
    rows = tap.recorder.rows(slot)
    trouble = tap.trouble or (f'{counted(tap.reader.unreadable, "message")} skipped: '
                              f'{tap.reader.trouble}' if tap.reader.unreadable else '')
    if trouble:
        facts['trouble'] = trouble
    if not len(rows.stamp_ns):
        return facts
    schema = cdr.SCHEMAS.get(info.msgtype)
    headerless = 'string header.frame_id' not in schema if schema else bool(
        (rows.stamp_ns == rows.received_ns).all())
    facts['timing'] = survey.timing(rows, bag.start_ns, headerless)
    facts['rate_hz'] = facts['timing'].pop('rate_hz') or facts['rate_hz']
    if slot == 'odometer':
        assert tap.form is not None      # an odometer's reader
        facts['odometer'] = survey.odometer(rows, tap.form) | {
            'meaning': f'odometer.quantity={tap.meaning.quantity}' if tap.meaning else ''}
    elif slot in ('imu', 'fix'):
        facts[slot] = (survey.imu if slot == 'imu' else survey.fixes)(rows)
    return facts


def _set_meanings(bag: Bag, taps: dict[str, _Tap], lists: dict[str, list[dict[str, Any]]],
                  fixes: FixPath) -> None:
    """Set the meaning of topics of one number that follow the fixes with another one only."""
    for name, tap in taps.items():
        if tap.reader.form and not lists.get(name):
            found = odometer_search.meaning(bag.topics[name], tap.recorder.rows('odometer'),
                                            tap.reader.form, fixes)
            tap.meaning = found if found is not tap.reader.form else None


def _matches(taps: dict[str, _Tap], lists: dict[str, list[dict[str, Any]]],
             fixes: FixPath) -> dict[str, Match]:
    """Return the comparison of each odometer topic with the path of the fixes."""
    found = {name: odometer_search.match_of(tap.recorder.rows('odometer'), tap.form, fixes)
             for name, tap in taps.items() if tap.form and not lists.get(name)}
    grows = {name: any(one['scale'] for one in some) for name, some in lists.items() if some}
    return found | {name: Match(float(some), 0.0, some) for name, some in grows.items()}


def _wheels(taps: dict[str, _Tap], mapping: dict[str, str], config: Config,
            topics: list[dict[str, Any]], lists: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Return the settings for the wheels; add the travel of each joint or entry to ``topics``."""
    options: list[str] = []
    open_ = not (config.odometer.keys or config.odometer.field)
    for facts in topics:
        if facts['name'] not in lists:
            continue
        tap, moves = taps[facts['name']], lists[facts['name']]
        facts['values'] = moves
        if len(moves) > 1:
            facts['moves'] = wheel_survey.in_words(moves)
        form = tap.reader.form
        assert form is not None      # a topic of lists is an odometer's
        if form.chosen:
            facts['chosen'] = form.chosen
        if facts['name'] == mapping.get('odometer') and open_:
            named = tap.reader.wheels if form.sides else ()
            rolling = {one['key'] for one in moves if one['rolls']}
            if len(named) > 1 and rolling.issuperset(named):
                options += [f'odometer.{side}={key}' for side, key in zip(
                    SIDES, named, strict=True)]
            else:
                options += (wheel_survey.suggested(moves)
                            or wheel_survey.alone(moves, tap.reader.wheels))
    return options


def _read_again(bag: Bag, taps: dict[str, _Tap], topic: str, config: Config,
                topics: list[dict[str, Any]]) -> None:
    tap = taps[topic] = _Tap(make_reader('odometer', bag.topics[topic].msgtype, config))
    bag.read({topic: tap}, print)
    facts = next(facts for facts in topics if facts['name'] == topic)
    facts.update(_topic(bag, bag.topics[topic], tap, '') | facts)


def _turn(imu: _Tap) -> tuple[Ints, Floats] | None:
    """Return stamps and the turn rate to the left, rad/s, None without usable rows."""
    rows = imu.recorder.rows('imu')
    rows = take(rows, ~(is_impossible('f_i', rows.f_i) | is_impossible('w_i', rows.w_i)))
    if not len(rows.stamp_ns):
        return None
    up_i = medians(rows.f_i)
    return rows.stamp_ns, rows.w_i @ (up_i / max(float(np.linalg.norm(up_i)), 1e-9))


def _together(taps: dict[str, _Tap], mapping: dict[str, str]) -> LegRecorder:
    recorder = LegRecorder()
    for slot, topic in mapping.items():
        if topic not in taps:
            continue
        rows = taps[topic].recorder
        if slot == 'odometer':
            recorder.form = taps[topic].reader.form or recorder.form
            for more in WHEELS[1:]:
                recorder.adopt(more, rows, more)
        if slot == 'odometer_right':
            recorder.form_right = taps[topic].reader.form
            recorder.adopt(slot, rows, 'odometer')
        elif taps[topic].reader.slot == slot:
            recorder.adopt(slot, rows, slot)
    return recorder
