# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read a bag into memory: samples of the chosen topics, marks of a node, settings of a journal."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from odocal_ros.bagio.read import Bag, bag_sha256, open_bag
from odocal_ros.bagio.segments import JOURNAL_FILE
from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import Leg, LegRecorder, SLOTS
from odocal_ros.data.samples import OdometerForm, Samples
from odocal_ros.errors import BadUsage
from odocal_ros.library import arguments
from odocal_ros.library.find_legs import find_legs, has_dropped_legs, last_statuses, marked_legs
from odocal_ros.messages.decode import make_reader, Reader
from odocal_ros.messages.transforms import add_static_readers
from odocal_ros.pipeline.floor_marks import (
    check_points,
    FloorMark,
    HALF_MARK,
    mark_positions,
    marks_at,
    settings_with_marks,
)
from odocal_ros.reasons import Reason
from odocal_ros.safe_io.limits import is_file
from odocal_ros.safe_io.text_formats import one_line
from odocal_ros.settings.config import Config

JOURNAL_BLOCK = 'odocal_journal'     # name of the metadata in the settings file of a journal
STILL_SHARE = 0.05      # judgement: over the largest travel in a second; if above, the robot moves


@dataclass(frozen=True)
class JournalNotes:
    """Settings of a journal's leg by dotted name, slot -> topic, and their file."""

    path: Path
    settings: dict[str, object] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)


def journal_notes(bag: Path) -> JournalNotes | None:
    """
    Return the metadata of a journal; None for other bags.

    Raises BadUsage: the settings file is not regular; BadConfig: its settings are not valid.
    """
    path = (bag if bag.is_dir() else bag.parent) / JOURNAL_FILE
    if not path.exists():
        return None
    if not is_file(path):
        raise BadUsage(f'{path} is not a regular file; remove it to replay the bag')
    from odocal_ros.settings.config_file import read_journal_file
    settings, metadata = read_journal_file(path, JOURNAL_BLOCK)
    topics = {slot: metadata[f'topics.{slot}'] for slot in SLOTS if f'topics.{slot}' in metadata}
    return JournalNotes(path, settings, topics)


@dataclass(frozen=True, eq=False)
class Recording:
    """A bag that was read."""

    name: str
    sha256: str
    topics: dict[str, str]                # slot -> topic
    imu_frame: str                        # frame_id of the IMU
    start_ns: int                         # bag time of its first message
    end_ns: int                           # bag time of its last message
    marks: tuple[tuple[int, int], ...]    # (start, stop) stamps by a node, stop 0 if missing
    dropped: bool                         # the operator dropped the leg of a journal
    notes: tuple[Reason, ...]             # reasons from the bag for its results
    config: Config                        # settings, including a journal's
    recorder: LegRecorder                 # the samples

    @property
    def form(self) -> OdometerForm:
        """Return the meaning of the odometer values."""
        return self.recorder.form

    def samples(self, slot: str) -> Samples:
        """Return the rows of a slot: imu, fix, fix_velocity, heading, one of data.leg.WHEELS."""
        rows: Samples = self.recorder.rows(slot)
        return rows

    def spans(self, legs: list[arguments.LegSpan | str]) -> list[tuple[int, int]]:
        """Return (start, stop) stamps of legs from ``legs_of``; if none, of the recorded legs."""
        return find_legs(self.recorder, self, legs, [] if legs else list(self.marks), self.config)

    def legs(self, legs: arguments.Leg | list[arguments.Leg] | None = None) -> list[Leg]:
        """Return the requested legs, or the recorded ones, for ``pipeline.calibrate``."""
        return [self.recorder.close(start, stop, self.config.leg.preroll)
                for start, stop in self.spans(arguments.legs_of(legs))]


def readers_of(bag: Bag, topics: Mapping[str, str], config: Config,
               journal: JournalNotes | None, listener: arguments.Listener | None = None,
               ) -> tuple[dict[str, str], dict[str, Reader]]:
    """Return slot -> topic, and topic -> reader; ``topics`` take precedence over a journal's."""
    from odocal_ros.library.topics import choose_topics, reference_note
    with_messages = {name for name, info in bag.topics.items() if info.count}
    requested = {slot: topic for slot, topic in (journal.topics if journal else {}).items()
                 if topic in with_messages} | dict(topics)
    mapping = choose_topics(bag.topics, config, requested, bool(floor_marks_of(config, bag)))
    note = reference_note(bag.topics, mapping, requested)
    if note and listener:
        listener.note(note)
    return mapping, {topic: make_reader(slot, bag.topics[topic].msgtype, config)
                    for slot, topic in mapping.items()}


def read_bag(path: Path | str, topics: Mapping[str, str] | None = None,
             config: arguments.Settings = None, *,
             listener: arguments.Listener | None = None) -> Recording:
    """
    Read a bag: a rosbag2 folder (sqlite3, mcap), a rosbag1 file, or a file of either.

    path : of the bag, or of a journal of the node, which contains settings and topics.
    topics, config, listener : as ``calibrate_bag``.

    Raises BadBag, BadData, BadUsage, BadConfig: the bag cannot be read, or an input is missing or
    ambiguous.
    """
    listener = listener or arguments.Listener()
    path = Path(path)
    journal = journal_notes(path)
    settings = arguments.config_of(config, journal.settings if journal else None)
    # the hash takes as long as reading the file: parallel to the decoding, which uses one core
    with open_bag(path) as bag, ThreadPoolExecutor(1) as executor:
        name = one_line(bag.name)
        floor_marks = floor_marks_of(settings, bag)
        if floor_marks:
            settings = settings_with_marks(settings)
        if journal:
            listener.note(f'{bag.name} is a journal: settings and topics come from '
                          f'{journal.path}; options take precedence')
        mapping, readers = readers_of(bag, topics or {}, settings, journal, listener)
        digest = executor.submit(bag_sha256, bag)
        with listener.phase(f'reading {name}') as progress:
            recorder = read_topics(bag, mapping, readers, progress)
        if settings.reference.marks:        # those of a node were tested when they were set
            check_wheels_stand(floor_marks, recorder, bag.start_ns)
        if floor_marks:
            recorder.feed('fix', mark_positions(settings, floor_marks))
        marks = marked_legs(bag)
        for note in bag.notes:
            if isinstance(note, str):
                listener.note(note)
        with listener.phase(f'checksum of {name}'):
            sha256 = digest.result()
        imu = mapping.get('imu', '')
        frame = readers[imu].frame or bag.frame(imu) if imu else ''
        return Recording(
            name, sha256, mapping, frame, bag.start_ns, bag.end_ns,
            tuple(marks), bool(journal and not marks and has_dropped_legs(bag)),
            tuple(note for note in bag.notes if not isinstance(note, str)), settings, recorder)


def read_topics(bag: Bag, mapping: dict[str, str], readers: dict[str, Reader],
                progress: arguments.Progress | None = None) -> LegRecorder:
    """Return the rows of topics by their readers; mapping: slot -> topic."""
    recorder = LegRecorder()
    bag.read(add_static_readers(readers, bag.topics), recorder.feed, progress)
    recorder.form = readers[mapping['odometer']].form or recorder.form
    if 'odometer_right' in mapping:
        recorder.form_right = readers[mapping['odometer_right']].form
    return recorder


def floor_marks_of(config: Config, bag: Bag) -> list[FloorMark]:
    """Return the marks of a bag in order of time, none without points."""
    reference = config.reference
    if reference.marks:
        check_points(config)
        return marks_at(config, [bag.start_ns + round(t * 1e9) for t in reference.marks])
    return _stored_marks(bag, len(reference.points) // 2) if reference.points else []


def _stored_marks(bag: Bag, points: int) -> list[FloorMark]:
    """Return the marks in the status of a node."""
    marks = set[FloorMark]()
    for values in last_statuses(bag):
        for word in filter(None, values.get('marks', '').split(',')):
            with suppress(ValueError):      # of another program
                marks.add(FloorMark.of(word))
    for mark in marks:
        if not 0 <= mark.point < points:
            raise BadUsage(f'the bag has a mark of point {mark.point + 1}, reference.points has '
                           f'{points}: use the points of the recording')
    return sorted(marks)


def check_wheels_stand(marks: Sequence[FloorMark], recorder: LegRecorder, start_ns: int) -> None:
    """Raise BadUsage for a mark in motion or outside the bag, which begins at start_ns."""
    rows = recorder.rows('odometer')
    t, total = (rows.stamp_ns - start_ns) * 1e-9, np.asarray(rows.value, dtype=float)
    if recorder.form.quantity != 'cumulative':
        total = np.cumsum(total)

    def travel_around(times: Floats) -> Floats:
        """Return the travel within HALF_MARK s before and after each time, raw units."""
        begin, end = times - HALF_MARK, times + HALF_MARK
        travel: Floats = np.interp(end, t, total) - np.interp(begin, t, total)
        return np.abs(travel)
    times = np.array([(mark.stamp_ns - start_ns) * 1e-9 for mark in marks])
    for time in times.tolist():
        if not (len(t) and t[0] <= time - HALF_MARK and time + HALF_MARK <= t[-1]):
            raise BadUsage(f'--mark {time:g}: the odometer has no data there; required: seconds '
                           'from the first message of the bag')
    largest = float(travel_around(np.arange(t[0] + HALF_MARK, t[-1], HALF_MARK)).max())
    for time, distance in zip(times.tolist(), travel_around(times).tolist(), strict=True):
        if distance > STILL_SHARE * largest:
            raise BadUsage(f'--mark {time:g}: the wheels turn within {HALF_MARK:g} s of it; '
                           'required: a time at which the robot stands on a point')
