# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Read a bag, in one pass, whatever its format: rosbag1, rosbag2 with sqlite3 or mcap.

In: a path. Out: its topics, and messages handed to readers in order of time. Split and compressed
bags, and damaged ones or those without metadata are read as far as possible, with notes.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, replace
import hashlib
import heapq
from operator import itemgetter
from pathlib import Path
import tempfile
from typing import Any

from odocal_ros.bagio.bag_file import BagFile, Batch, group_overlapping, in_batches
from odocal_ros.bagio.mcap_file import McapFile
from odocal_ros.bagio.rosbags_readers import Rosbag1File, Types
from odocal_ros.bagio.sources import file_names, find_source, Source, unpack
from odocal_ros.bagio.sqlite_file import SqliteFile
from odocal_ros.errors import BadBag, BadData, BadTopics, OdocalError
from odocal_ros.messages import cdr
from odocal_ros.messages.decode import Feed, RowReader
from odocal_ros.reasons import Code, Reason
from odocal_ros.safe_io.limits import Allowance, Damaged, is_file
from odocal_ros.safe_io.text_formats import indented_list, one_line

MIN_LOSS_S = 0.5   # judgement: shorter losses are not reported


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag, its type and its number of messages."""

    name: str
    msgtype: str
    count: int


class Bag:
    """
    An open bag: its topics and its messages.

    ``start_ns`` and ``end_ns`` are the bag times of the first and the last message. ``notes`` are
    messages for the user: sentences, and reasons if they concern a result.
    """

    def __init__(self, source: Source, bag_files: list[BagFile], types: Types) -> None:
        self.name, self.files = source.name, source.files
        self._source, self._types = source, types
        self._bag_files = sorted((file for file in bag_files if file.count),
                                 key=lambda file: file.start_ns)
        self._reader_notes: list[Reason] = []
        self._sentences = list(source.notes)
        self.topics = self._find_topics()
        self.start_ns = min(file.start_ns for file in self._bag_files)
        self.end_ns = max(file.end_ns for file in self._bag_files)

    def _find_topics(self) -> dict[str, TopicInfo]:
        """Return the topics of all files, each with its most frequent type."""
        counts: dict[str, dict[str, int]] = {}
        for bag_file in self._bag_files:
            for channel in bag_file.channels:
                self._types.define(channel.msgtype, channel.definition)
                types = counts.setdefault(channel.topic, {})
                types[channel.msgtype] = types.get(channel.msgtype, 0) + channel.count
        for topic, types in counts.items():
            if len(types) > 1:
                self._sentences.append(f'{topic} has messages of {len(types)} types '
                                       f'({", ".join(types)}); the most frequent is used')
        most_frequent = {topic: max(types.items(), key=itemgetter(1))
                         for topic, types in counts.items()}
        return {topic: TopicInfo(topic, *most_frequent[topic]) for topic in sorted(counts)}

    @property
    def notes(self) -> tuple[Reason | str, ...]:
        """Return the notes on this bag; complete only after it was read."""
        return (*self._sentences, *self._missing_data_notes(), *self._reader_notes)

    def _missing_data_notes(self) -> list[Reason | str]:
        """Return notes on missing data, with its duration if metadata or the next file give it."""
        notes: list[Reason | str] = []
        metadata = self._source.metadata
        for bag_file, next_file in zip(self._bag_files, [*self._bag_files[1:], None], strict=True):
            if not bag_file.damage:
                continue
            span = metadata.file_spans.get(bag_file.recorded_path.name) or (
                metadata.bag_span if len(self._bag_files) == 1 else None)
            damage = f'{bag_file.recorded_path.name} is damaged ({bag_file.damage})'
            if span and bag_file.count >= span.count:
                notes.append(f'{damage}, but all {span.count} messages were read')
                continue
            if not bag_file.count:
                notes.append(Reason(Code.BAG_TRUNCATED, f'{damage}: none of its messages can be '
                                    'read'))
                continue
            span = span or (metadata.bag_span if next_file is None else None)
            end_ns = span.end_ns if span else next_file.start_ns if next_file else None
            seconds = (bag_file.end_ns - bag_file.start_ns) * 1e-9
            lost_s = 0.0 if end_ns is None else (end_ns - bag_file.end_ns) * 1e-9
            loss = ('without metadata.yaml the lost time is unknown' if end_ns is None else
                    f'{lost_s:.1f} s at the end are missing' if lost_s > MIN_LOSS_S else
                    'messages before the end are missing')
            notes.append(Reason(Code.BAG_TRUNCATED, f'{damage}: {bag_file.count} messages in '
                                f'{seconds:.1f} s were read; {loss}'))
        lost_s = (metadata.bag_span.end_ns - self.end_ns) * 1e-9 if metadata.bag_span else 0.0
        if not notes and lost_s > MIN_LOSS_S:
            notes.append(Reason(Code.BAG_TRUNCATED, f'{self.name}: {lost_s:.1f} s at the end, '
                                'listed in metadata.yaml, are missing'))
        return notes

    def read(self, readers: Mapping[str, RowReader], feed: Feed,
             progress: Callable[[float], None] | None = None) -> None:
        """
        Read topics in one pass.

        readers : topic -> reader of its messages.   feed : called with (slot, block) of samples,
        in order of bag time.   progress : called with the fraction done.

        Raises BadTopics, BadBag, BadData: a topic is not in the bag; none of the messages can be
        read; none of a topic's can be used.
        """
        for topic in readers.keys() - self.topics.keys():
            raise BadTopics(f'{self.name}: no topic {one_line(topic)}; the bag has:'
                            f'{indented_list(list(self.topics))}')
        deserialize = {topic: self._types.deserializer(self.topics[topic].msgtype)
                       for topic in readers}
        row_counts = dict.fromkeys(readers, 0)
        for batch in self._batches(readers.keys()):
            for topic, (times, raws) in batch.items():
                for slot, block in readers[topic].rows(raws, times, deserialize[topic]):
                    row_counts[topic] += len(block.stamp_ns)
                    feed(slot, block)
            if progress:
                newest = int(max(times[-1] for times, _ in batch.values()))
                progress((newest - self.start_ns) / max(self.end_ns - self.start_ns, 1))
        # reading finds damaged chunks
        _check_has_messages(self.name, self._source, self._bag_files)
        for topic, reader in readers.items():
            self._add_notes(topic, reader, row_counts[topic])

    def _add_notes(self, topic: str, reader: RowReader, row_count: int) -> None:
        """Add a note on messages without a row; raise BadData if none has a row."""
        if not reader.unreadable:
            return
        count = self.topics[topic].count
        if not row_count:
            raise BadData(f'{topic}: none of its {count} messages can be used: {reader.error}')
        self._reader_notes.append(Reason(
            Code.BAD_ROWS_DROPPED, f'{reader.unreadable} of {count} messages of {topic} were '
            f'skipped: {reader.error}'))

    def messages(self, topic: str) -> Iterator[tuple[int, object]]:
        """Yield (bag time ns, deserialised message) of a topic; empty without that topic."""
        if topic in self.topics:
            yield from self._converted(topic, self._types.deserializer(self.topics[topic].msgtype))

    def frame(self, topic: str) -> str:
        """Return the frame_id of the first readable message of a topic; '' if there is none."""
        msgtype = self.topics[topic].msgtype
        deserialize = self._types.deserializer(msgtype)

        def frame_of(raw: bytes) -> str:
            frame = cdr.frame_of(msgtype, raw)
            return deserialize(raw).header.frame_id if frame is None else frame
        return next((frame for _, frame in self._converted(topic, frame_of)), '')

    def _converted(self, topic: str,
                   convert: Callable[[bytes], Any]) -> Iterator[tuple[int, Any]]:
        """Yield bag time, ns, and result of ``convert`` for each message that it can convert."""
        for batch in self._batches({topic}):
            times, raws = batch[topic]
            for time_ns, raw in zip(times.tolist(), raws, strict=True):
                try:
                    message = convert(raw)
                except (OdocalError, MemoryError):
                    raise
                except Exception:   # a damaged message is skipped
                    continue
                yield time_ns, message

    def _batches(self, topics: Collection[str]) -> Iterator[Batch]:
        """Yield messages of some topics in order of bag time, many at a time."""
        types = {t: self.topics[t].msgtype for t in topics if self.topics[t].count}
        for group in group_overlapping(self._bag_files):
            yield from _merged(group, types)


def _merged(bag_files: list[BagFile], topics: Mapping[str, str]) -> Iterator[Batch]:
    """Return the batches of files that overlap in time, merged; those of one file unchanged."""
    if len(bag_files) == 1:
        return bag_files[0].batches(topics)
    return in_batches(heapq.merge(*(file.stream(topics) for file in bag_files),
                                  key=itemgetter(1)))


@contextmanager
def open_bag(path: Path | str) -> Iterator[Bag]:
    """Open a bag, a folder or a file, in a ``with``; raise BadBag without usable content."""
    with ExitStack() as stack:
        try:
            bag = _open_bag(Path(path), stack)
        except PermissionError as error:
            raise BadBag(f'{error.filename or path}: no permission to read it') from None
        except OSError as error:
            raise BadBag(f'{path}: cannot be read ({error.strerror or error})') from None
        yield bag


def _open_bag(path: Path, stack: ExitStack) -> Bag:
    source, types = find_source(path), Types()
    if foreign := source.metadata.foreign_formats:
        raise BadBag(f'{path}: its serialization format is {foreign!r}, only cdr is supported; '
                     'convert the bag with ros2 bag convert')
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='odocal_')))
    bag_files: list[BagFile] = []
    errors = []
    bag_bytes = sum(file.stat().st_size for file in source.files if is_file(file))
    for file in source.files:
        try:
            bag_file = _open_file(file, folder, bag_bytes, types)
        except BadBag as error:
            errors.append(error)
            continue
        stack.callback(bag_file.close)
        bag_files.append(bag_file)
    if not bag_files:
        raise errors[0]
    bag_notes = tuple(Reason(Code.BAG_TRUNCATED, f'{error}; the other files are read')
                      for error in errors)
    formats = {c.serialization for bag_file in bag_files for c in bag_file.channels if c.count}
    if formats and not formats & {'cdr', 'ros1'}:
        raise BadBag(f'{path}: its serialization format is {", ".join(formats)!r}, '
                     'only cdr is supported; convert the bag with ros2 bag convert')
    _check_has_messages(path, source, bag_files)
    return Bag(replace(source, notes=source.notes + bag_notes), bag_files, types)


def _open_file(path: Path, folder: Path, bag_bytes: int, types: Types) -> BagFile:
    """Return an open file of a bag of ``bag_bytes``, unpacked into ``folder`` if needed."""
    file, kind = unpack(path, folder, bag_bytes)
    allowance = Allowance(path, bag_bytes)
    try:
        if kind == '.bag':
            bag_file: BagFile = Rosbag1File(file, allowance, types.cdr_from_ros1)
        else:
            bag_file = (McapFile if kind == '.mcap' else SqliteFile)(file, allowance)
    except (Damaged, ValueError) as error:
        raise BadBag(f'{path}: cannot be read ({error})') from None
    bag_file.recorded_path = path
    return bag_file


def _check_has_messages(path: Path | str, source: Source, bag_files: list[BagFile]) -> None:
    if any(bag_file.count for bag_file in bag_files):
        return
    damage = ' or '.join({bag_file.damage for bag_file in bag_files if bag_file.damage})
    if damage:
        raise BadBag(f'{path}: the messages of {file_names(source.files)} cannot be read '
                     f'({damage}); copy it again from its source')
    topics = sum(len(bag_file.channels) for bag_file in bag_files)
    raise BadBag(f'{path}: the bag is empty, 0 messages on {topics} topics in '
                 f'{file_names(source.files)}; record again')


def bag_sha256(bag: Bag) -> str:
    """Return the SHA-256 of a bag; several files: that of the output of sha256sum for them."""
    digests = []
    for path in bag.files:
        with path.open('rb') as file:
            digests.append((hashlib.file_digest(file, 'sha256').hexdigest(), path.name))
    if len(digests) == 1:
        return digests[0][0]
    lines = ''.join(f'{digest}  {name}\n' for digest, name in digests)
    return hashlib.sha256(lines.encode()).hexdigest()
