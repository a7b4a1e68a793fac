# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A bag that grows by closed files (segments): a killed process only loses the newest second.

While it grows it is a folder of numbered files without metadata.yaml; sixty of them are repeatedly
joined into one, all of them at the end. A joined file is complete before the single files are
removed, and its name has their numbers: a reader that finds both uses the joined one.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import re
from typing import Any

from odocal_ros.bagio.bag_file import Channel
from odocal_ros.bagio.mcap_write import PackedChunk, read_chunks, write_file, Written
from odocal_ros.safe_io.atomic_files import disk, write_text

JOURNAL_FILE = 'journal.yaml'     # marks the folder as a journal, and has its settings
# the node's status, which contains the marks of legs; its events for legs that replay omits
STATUS_NAME, STATUS_TYPE = 'calibrator: calibration', 'diagnostic_msgs/msg/DiagnosticArray'
DROPPED_EVENTS = ('cancelled', 'undone')
NUMBERED = re.compile(r'part_(\d+)(?:-(\d+))?\.mcap')
FILES_JOINED = 60        # judgement: files joined at once: an hour then has at most 60 + 60


def part_name(first: int, last: int) -> str:
    """Return the name of a file with the segments ``first`` to ``last``."""
    return f'part_{first:06}.mcap' if first == last else f'part_{first:06}-{last:06}.mcap'


def joined_name(folder: Path, number: int = 0) -> str:
    """Return the name of the file with all segments (0), or of one added to it later."""
    return f'{folder.name}_{number}.mcap'


def without_duplicates(files: Sequence[Path]) -> list[Path]:
    """Return the files of a journal without those whose messages are also in another file."""
    matches = {path: NUMBERED.fullmatch(path.name) for path in files}
    without_number = [path for path, match in matches.items() if match is None]
    if any(path.name.endswith('_0.mcap') for path in without_number):
        return without_number      # all are joined, and metadata.yaml was not yet written
    joined = [(int(match[1]), int(match[2])) for match in matches.values() if match and match[2]]
    return [path for path, match in matches.items() if not match or match[2] or not any(
        first <= int(match[1]) <= last for first, last in joined)]


@dataclass(frozen=True)
class Segment:
    """A file of the bag, and its first and last segment number."""

    path: Path
    first: int
    last: int
    written: Written


class SegmentedBag:
    """Writer of segments into a folder; files written before an OSError stay valid."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.channels: dict[int, Channel] = {}   # by number, as in chunks
        self.segments: list[Segment] = []
        self.later_files: list[Segment] = []     # added to the finished bag

    @property
    def size(self) -> int:
        return _size((*self.segments, *self.later_files))

    @property
    def unjoined_size(self) -> int:
        """Return the size of the files that are joined next, bytes."""
        return _size(self._unjoined())

    def _unjoined(self) -> list[Segment]:
        # the first has the size of the pre-roll: it is only copied once
        return [s for s in self.segments[1:] if s.first == s.last]

    def append(self, chunks: Sequence[PackedChunk]) -> None:
        number = self.segments[-1].last + 1 if self.segments else 0
        self.segments.append(self._write(part_name(number, number), number, number, chunks))

    def join_some(self) -> None:
        """Join the newest segments if there are enough of them."""
        single = self._unjoined()
        if len(single) >= FILES_JOINED:
            self._join(single)

    def finish(self, free_bytes: int | None = None) -> Path:
        """
        Join all segments into one file and write metadata.yaml; return the file.

        If ``free_bytes`` or the disk is too small for the copy, the segments remain.
        """
        if free_bytes is None or self.size <= free_bytes:
            try:
                self.segments = [self._write(joined_name(self.folder), 0, self.segments[-1].last,
                                             _chunks_of(self.segments))]
            except OSError:
                self._write_metadata()
                return self.segments[0].path
        self._write_metadata()
        for path in self.folder.glob('part_*.mcap'):
            if path not in {segment.path for segment in self.segments}:
                disk(os.unlink, path)
        return self.segments[0].path

    def add(self, chunks: Sequence[PackedChunk]) -> None:
        """Add messages to the finished bag, as a file of its own."""
        number = len(self.later_files) + 1
        self.later_files.append(self._write(joined_name(self.folder, number), 0, 0, chunks))
        self._write_metadata()

    def _join(self, segments: list[Segment]) -> None:
        first, last = segments[0].first, segments[-1].last
        joined = self._write(part_name(first, last), first, last, _chunks_of(segments))
        index = self.segments.index(segments[0])
        self.segments[index:index + len(segments)] = [joined]
        for segment in segments:
            disk(os.unlink, segment.path)

    def _write(self, name: str, first: int, last: int, chunks: Iterable[PackedChunk]) -> Segment:
        path = self.folder / name
        return Segment(path, first, last, write_file(path, self.channels, chunks))

    def _write_metadata(self) -> None:
        path = self.folder / 'metadata.yaml'
        write_text(path, _metadata([*self.segments, *self.later_files], self.channels))


def _size(segments: Iterable[Segment]) -> int:
    return sum(segment.written.size for segment in segments)


def _chunks_of(segments: Iterable[Segment]) -> Iterator[PackedChunk]:
    for segment in segments:
        yield from read_chunks(segment.path)


def _metadata(files: Sequence[Segment], channels: Mapping[int, Channel]) -> str:
    import yaml
    written = [file.written for file in files]
    counts: Counter[int] = sum((file.counts for file in written), Counter())
    text: str = yaml.safe_dump({'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap',
        **_span(min(file.start_ns for file in written),
                max(file.end_ns for file in written), counts),
        'topics_with_message_count': [
            {'topic_metadata': {'name': c.topic, 'type': c.msgtype, 'serialization_format': 'cdr',
                                'offered_qos_profiles': [], 'type_description_hash': ''},
             'message_count': counts[number]} for number, c in channels.items()],
        'compression_format': '', 'compression_mode': '',
        'relative_file_paths': [file.path.name for file in files],
        'files': [{'path': file.path.name, **_span(
            file.written.start_ns, file.written.end_ns, file.written.counts)} for file in files],
        'custom_data': None, 'ros_distro': 'jazzy'}}, sort_keys=False)
    return text


def _span(start_ns: int, end_ns: int, counts: Counter[int]) -> dict[str, Any]:
    return {'starting_time': {'nanoseconds_since_epoch': start_ns},
            'duration': {'nanoseconds': end_ns - start_ns},
            'message_count': counts.total()}
