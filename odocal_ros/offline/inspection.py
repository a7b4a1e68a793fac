# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The content of a bag for odocal inspect and try, as one dict that becomes text or JSON.

It has facts of each topic, the most likely topic of each input, facts of the drive, findings
(problems and missing data), and the replay command with the settings that the bag needs.
"""

from collections.abc import Sequence
from datetime import datetime, UTC
from typing import Any, NamedTuple

from odocal_ros.bagio.read import Bag, TopicInfo
from odocal_ros.data.arrays import Ints
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import OdometerForm
from odocal_ros.errors import OdocalError
from odocal_ros.library.topics import is_estimate, REFERENCES
from odocal_ros.messages import cdr
from odocal_ros.messages.decode import Deserialize, make_reader, Reader
from odocal_ros.messages.message_fields import IMU, Pairs
from odocal_ros.messages.odometer_types import TYPES as ODOMETERS
from odocal_ros.messages.transforms import add_static_readers, STATIC
from odocal_ros.offline import odometer_search, survey, wheel_survey
from odocal_ros.offline.inspection_drive import DriveInspection, inspect_drive
from odocal_ros.offline.missing_inputs import finding_facts, missing_input_reasons
from odocal_ros.offline.suggest import likely_mapping, replay_command, replay_refusal
from odocal_ros.offline.survey import fix_path, FixPath, Match
from odocal_ros.offline.topic_notes import partial_imus, topic_notes
from odocal_ros.output.files import plain
from odocal_ros.output.value_text import counted
from odocal_ros.reasons import Reason
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.settings.config import Config, SIDES, with_settings
from odocal_ros.settings.config_file import parse_set


class _TopicSamples:
    """A reader that stores its samples; an error is stored in ``error``, for other topics."""

    unreadable = 0      # for the bag: one bad topic must not end the reading of the others

    def __init__(self, reader: Reader) -> None:
        self.reader, self.recorder, self.error = reader, LegRecorder(), ''
        has_list = reader.msgtype in wheel_survey.FIELDS
        self.lists = wheel_survey.ListCollector(reader.msgtype) if has_list else None
        self.form_by_fixes: OdometerForm | None = None

    @property
    def form(self) -> OdometerForm | None:
        """Return the meaning of odometer values: by the fixes if known, else by the type."""
        return self.form_by_fixes or self.reader.form

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Store the samples of a block of messages; return none."""
        if self.lists:
            self.lists.rows(raws, received_ns)
        try:
            for slot, block in self.reader.rows(raws, received_ns, deserialize):
                self.recorder.feed(slot, block)
        except OdocalError as error:
            self.error = str(error)
        return []


class _Selection(NamedTuple):
    """The most likely topics of a bag."""

    mapping: dict[str, str]         # slot -> topic
    unusual: dict[str, Any]         # of the content: unsuitable and undefined topics, notes
    topics: list[dict[str, Any]]    # facts of all topics
    initial_config: Config          # the settings given, with those by the names of topics
    options: list[str]              # settings that the odometer needs


def inspect(bag: Bag, path: str, config: Config, overrides: dict[str, str]) -> dict[str, Any]:
    """
    Return the content of a bag, as for ``odocal inspect --json``.

    Times are seconds from the bag's first message, angles rad, the rest SI.
    """
    samples_by_topic, errors = _make_samples(bag, config, overrides)
    mapping, unusual, topics, initial_config, options = _select_topics(
        bag, samples_by_topic, errors, config, overrides)
    config = with_settings(initial_config, dict(map(parse_set, options)))
    if options:
        _read_again(bag, samples_by_topic, mapping['odometer'], config, topics)
    drive = DriveInspection()
    if {'imu', 'odometer'} <= mapping.keys():
        drive = inspect_drive(bag, _combined_recorder(samples_by_topic, mapping), config)
    options += drive.options
    content = {**_bag_facts(bag, path), 'topics': topics, 'mapping': mapping, **unusual,
               **drive.content}
    if 'fix' in mapping:
        config = settings_by_frame(samples_by_topic[mapping['fix']].recorder.rows('fix'), config)
    findings = [*(note for note in bag.notes if isinstance(note, Reason)), *drive.findings,
                *missing_input_reasons(content, mapping, config)]
    return dict(plain(content | {
        'findings': finding_facts(findings, config, options),
        'replay_error': replay_refusal(bag.topics, initial_config, overrides), 'command':
        replay_command(path, bag.topics, initial_config, overrides, mapping, options)}))


def _select_topics(bag: Bag, samples_by_topic: dict[str, _TopicSamples], errors: dict[str, str],
                   config: Config, overrides: dict[str, str]) -> _Selection:
    """Read all possible inputs; return the topics by names, types, and the path of the fixes."""
    collectors = odometer_search.make_collectors(bag.topics, samples_by_topic, overrides.values())
    # these readers store samples and return none, so that the second argument is not called
    bag.read({**samples_by_topic, **collectors, **_static_readers(samples_by_topic, bag)}, print)
    # first by names and types only; again after the comparison with the fixes
    quantities = {name: survey.measured_quantities(topic_samples.recorder.rows('imu'))
                  for name, topic_samples in samples_by_topic.items()
                  if topic_samples.reader.slot == 'imu'}
    partial = partial_imus(quantities)
    mapping, config = likely_mapping(bag.topics, config, overrides, partial)
    imu, fix = (samples_by_topic.get(mapping.get(slot, '')) for slot in ('imu', 'fix'))
    turn_rate = survey.turn_rate_to_left(imu.recorder.rows('imu')) if imu else None
    fixes = fix_path(fix.recorder.rows('fix'), config.gnss) if fix else None
    motions = {name: topic_samples.lists.facts(turn_rate, fixes)
               for name, topic_samples in samples_by_topic.items() if topic_samples.lists}
    matches = _matches(bag, samples_by_topic, motions, fixes, config) if fixes else {}
    not_following = odometer_search.topics_not_following(matches)
    mapping, config = likely_mapping(bag.topics, config, overrides, not_following | partial)
    fields = {name: collector.facts(fixes) for name, collector in collectors.items()
              if fixes and not collector.error}
    odometer_search.drop_weak_fields(fields.values())
    # an odometer of another type is suggested if no topic with a reader is one
    needs_field = mapping.get('odometer') not in samples_by_topic or (
        'odometer' not in overrides and (is_estimate(mapping['odometer']) or (
            matches and not any(match.follows for match in matches.values()))))
    field_topic = odometer_search.best_topic(
        fields, overrides.get('odometer', '')) if needs_field else ''
    if field_topic:
        mapping.pop('odometer_right', None)
        mapping['odometer'] = field_topic
        options = collectors[field_topic].settings(fields[field_topic]['found'], turn_rate)
    else:
        options = _wheel_options(samples_by_topic, mapping, config, motions)
    topics = [_topic_facts(bag, info, samples_by_topic.get(name), errors.get(name, ''))
              for name, info in bag.topics.items()]
    for facts in topics:
        name = facts['name']
        if 'odometer' in facts:
            facts['odometer']['not_following'] = name in not_following
        facts |= {'fields': fields[name]} if name in fields else {}
        if name in motions and not field_topic:
            facts |= wheel_survey.list_facts(samples_by_topic[name].reader, motions[name])
    undefined = {name: bag.topics[name].msgtype for name, collector in collectors.items()
                 if collector.is_undefined}
    return _Selection(mapping, {
        'not_following': sorted(not_following), 'partial_imus': sorted(partial),
        'undefined': undefined, 'topic_notes': topic_notes(
            mapping, overrides, quantities, undefined)}, topics, config, options)


def _bag_facts(bag: Bag, path: str) -> dict[str, Any]:
    return {
        'bag': bag.name, 'path': path, 'files': [str(f) for f in bag.files],
        'start': bag.start_ns * 1e-9, 'duration': (bag.end_ns - bag.start_ns) * 1e-9,
        'start_utc': datetime.fromtimestamp(bag.start_ns // 10**9, UTC).isoformat(),
        'messages': sum(info.count for info in bag.topics.values()),
        'notes': [note for note in bag.notes if isinstance(note, str)]}


def _make_samples(bag: Bag, config: Config,
                  overrides: dict[str, str]) -> tuple[dict[str, _TopicSamples], dict[Any, Any]]:
    """Return topic -> samples of every possible input, and topic -> error without a reader."""
    slot_by_topic = {topic: slot for slot, topic in overrides.items()}
    samples_by_topic: dict[str, _TopicSamples] = {}
    errors: dict[str, str] = {}
    for name, info in bag.topics.items():
        slot = slot_by_topic.get(name) or ('imu' if info.msgtype == IMU else '') or (
            'fix' if info.msgtype in REFERENCES else '') or (
            'odometer' if info.msgtype in (*ODOMETERS, config.odometer.type) else '')
        if not slot or not info.count:
            continue
        slot = 'odometer' if slot == 'odometer_right' else slot
        try:
            samples_by_topic[name] = _TopicSamples(make_reader(slot, info.msgtype, config))
        except OdocalError as error:
            errors[name] = str(error)
    return samples_by_topic, errors


def _static_readers(samples_by_topic: dict[str, _TopicSamples],
                    bag: Bag) -> dict[str, _TopicSamples]:
    """Return the readers of static transforms; they share the recorder of their TF topic."""
    readers = {name: topic_samples.reader for name, topic_samples in samples_by_topic.items()}
    static = {name: _TopicSamples(reader) for name, reader in add_static_readers(
        readers, bag.topics).items() if name not in readers}
    for name, topic_samples in static.items():
        topic_samples.recorder = samples_by_topic[name.removesuffix(STATIC)].recorder
    return static


def _topic_facts(bag: Bag, info: TopicInfo, topic_samples: _TopicSamples | None,
                 error: str) -> dict[str, Any]:
    seconds = (bag.end_ns - bag.start_ns) * 1e-9
    facts: dict[str, Any] = {'name': info.name, 'type': info.msgtype, 'count': info.count,
                             'rate_hz': survey.rate_of(info.count, seconds)}
    if topic_samples is None:
        return facts | ({'error': error} if error else {})
    reader, slot = topic_samples.reader, topic_samples.reader.slot
    rows = topic_samples.recorder.rows(slot)
    error = topic_samples.error or (
        f'{counted(reader.unreadable, "message")} skipped: {reader.error}'
        if reader.unreadable else '')
    if error:
        facts['error'] = error
    if not len(rows.stamp_ns):
        return facts
    schema = cdr.SCHEMAS.get(info.msgtype)
    headerless = 'string header.frame_id' not in schema if schema else bool(
        (rows.stamp_ns == rows.received_ns).all())
    facts['timing'] = survey.timing_facts(rows, bag.start_ns, headerless)
    facts['rate_hz'] = facts['timing'].pop('rate_hz') or facts['rate_hz']
    if slot == 'odometer':
        assert topic_samples.form is not None      # an odometer's reader
        facts['odometer'] = survey.odometer_facts(rows, topic_samples.form) | {
            'meaning': f'odometer.quantity={topic_samples.form_by_fixes.quantity}'
            if topic_samples.form_by_fixes else ''}
    elif slot in ('imu', 'fix'):
        facts[slot] = (survey.imu_facts if slot == 'imu' else survey.fix_facts)(rows)
    return facts


def _matches(bag: Bag, samples_by_topic: dict[str, _TopicSamples],
             motions: dict[str, list[dict[str, Any]]], fixes: FixPath,
             config: Config) -> dict[str, Match]:
    """
    Return the comparison of each odometer topic with the path of the fixes.

    motions : of each value of a topic with lists. A topic of one number that only follows the path
    with another meaning gets this meaning.
    """
    following = {name: any(value['scale'] for value in values)
                 for name, values in motions.items() if values}
    matches = {name: Match(float(follows), 0.0, follows) for name, follows in following.items()}
    for name, topic_samples in samples_by_topic.items():
        form, rows = topic_samples.reader.form, topic_samples.recorder.rows('odometer')
        if form and name not in matches:
            if config.odometer.quantity == 'auto':
                other = odometer_search.form_by_fixes(bag.topics[name], rows, form, fixes)
                topic_samples.form_by_fixes = other if other is not form else None
            matches[name] = odometer_search.match_of(rows, topic_samples.form or form, fixes)
    return matches


def _wheel_options(samples_by_topic: dict[str, _TopicSamples], mapping: dict[str, str],
                   config: Config, motions: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Return the settings for the selected odometer topic: its wheels, or its meaning."""
    topic = mapping.get('odometer', '')
    odometer = samples_by_topic.get(topic)
    options: list[str] = []
    if odometer and topic in motions and not (config.odometer.wheel_keys or config.odometer.field):
        values, wheels, form = motions[topic], odometer.reader.wheels, odometer.reader.form
        named = wheels if form and form.sides_known else ()
        rolling = {value['key'] for value in values if value['rolls']}
        if len(named) > 1 and rolling.issuperset(named):
            options += [f'odometer.{side}={key}' for side, key in zip(SIDES, named, strict=True)]
        else:
            options += wheel_survey.wheel_settings(values) or (
                wheel_survey.single_wheel_setting(values, wheels))
    if odometer and odometer.form_by_fixes:
        options.append(f'odometer.quantity={odometer.form_by_fixes.quantity}')
    return options


def _read_again(bag: Bag, samples_by_topic: dict[str, _TopicSamples], topic: str, config: Config,
                topics: list[dict[str, Any]]) -> None:
    """Read the odometer with the suggested settings; add its facts to ``topics``."""
    reader = make_reader('odometer', bag.topics[topic].msgtype, config)
    topic_samples = samples_by_topic[topic] = _TopicSamples(reader)
    bag.read({topic: topic_samples}, print)
    facts = next(facts for facts in topics if facts['name'] == topic)
    facts.update(_topic_facts(bag, bag.topics[topic], topic_samples, '') | facts)


def _combined_recorder(samples_by_topic: dict[str, _TopicSamples],
                       mapping: dict[str, str]) -> LegRecorder:
    """Return the samples of the selected topics in one recorder, by slot."""
    recorder = LegRecorder()
    for slot, topic in mapping.items():
        if topic not in samples_by_topic:
            continue
        reader, source = samples_by_topic[topic].reader, samples_by_topic[topic].recorder
        if slot == 'odometer':
            recorder.form = reader.form or recorder.form
            for wheel in WHEELS[1:]:
                recorder.adopt(wheel, source, wheel)
        if slot == 'odometer_right':
            recorder.form_right = reader.form
            recorder.adopt(slot, source, 'odometer')
        elif reader.slot == slot:
            recorder.adopt(slot, source, slot)
    return recorder
