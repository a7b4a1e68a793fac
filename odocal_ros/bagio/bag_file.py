# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Base class of the files of a bag: one interface for mcap, sqlite3 and rosbag1.

Out: the topics of a file with counts and times, and its messages as CDR, one by one in order of
time or many at a time.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
import heapq
from operator import itemgetter
import os
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Ints
from odocal_ros.messages.raws import RawMessages
from odocal_ros.safe_io.limits import Allowance, LATEST_NS, LimitReached

PREALLOCATED_BYTES = 2**23      # judgement: larger than a block of a file that is read at once
BATCH_MESSAGES, BATCH_BYTES = 20_000, 2**24      # judgement: limits of a batch
ZSTD = b'\x28\xb5\x2f\xfd'      # format: first bytes of compressed data
# language of a message definition, by its name in a bag
FORMATS = {'ros2msg': 'msg', 'ros2idl': 'idl', 'omgidl': 'idl'}


class FileBytes:
    """The bytes of a file at the time of opening, by offset."""

    def __init__(self, path: Path) -> None:
        # glibc returns a released block of memory to the system, and allocates all its pages again
        # for the next one, unless a larger block was released earlier
        np.empty(PREALLOCATED_BYTES, np.uint8)
        self._path = path
        self._file = path.open('rb')
        self._size = os.fstat(self._file.fileno()).st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, place: slice) -> bytes:
        """Return the bytes of a slice of step 1; OSError names the file."""
        start, stop, _ = place.indices(self._size)
        try:
            parts = []
            while start < stop and (part := os.pread(self._file.fileno(), stop - start, start)):
                parts.append(part)
                start += len(part)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from None
        return parts[0] if len(parts) == 1 else b''.join(parts)

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True)
class Channel:
    """A topic of a bag file; ``definition`` is (language: 'msg', 'idl' or '', text)."""

    topic: str
    msgtype: str
    count: int = 0
    serialization: str = 'cdr'
    definition: tuple[str, str] = ('', '')


Batch = dict[str, tuple[Ints, RawMessages]]  # topic -> bag times and messages, in order of time


class BagFile:
    """
    A file of a bag: its channels by number, their counts, first and last time.

    ``path`` is the file that is read, ``recorded_path`` that of the user, which may be compressed.
    ``damage`` describes the first damage found so far, empty if none.
    """

    def __init__(self, path: Path, allowance: Allowance) -> None:
        self.path = self.recorded_path = path
        self.damage = ''
        self._allowance = allowance
        self.start_ns, self.end_ns, self.count = 2**63 - 1, 0, 0
        self._channels: dict[int, Channel] = {}

    def batches(self, topics: Mapping[str, str]) -> Iterator[Batch]:
        """Yield the messages of some topics (name -> type), many at a time, decompressed."""
        is_compressed = None       # each message on its own; CDR starts with a zero byte
        for batch in self._fast_batches(topics) or in_batches(self.messages(topics)):
            if is_compressed is None:
                is_compressed = any(raws[0][:4] == ZSTD for _, raws in batch.values())
            yield {topic: (times, RawMessages.joined([self._decompressed(raw) for raw in raws]))
                   for topic, (times, raws) in batch.items()} if is_compressed else batch

    def stream(self, topics: Mapping[str, str]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, time, ns, and bytes of each message by time, to merge files; slower."""
        channels = {c.topic: c for c in self.channels}
        for batch in self.batches(topics):
            lists = ([(channels[topic], time_ns, raw) for time_ns, raw in zip(
                times.tolist(), raws, strict=True)] for topic, (times, raws) in batch.items())
            yield from heapq.merge(*lists, key=itemgetter(1))

    def _decompressed(self, raw: bytes) -> bytes:
        """Return a message decompressed, b'' if it is damaged: readers count it as unreadable."""
        try:
            return bytes(self._allowance.unpack('zstd', raw))
        except (LimitReached, MemoryError):
            raise
        except Exception:
            return b''

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Yield the messages as stored: Channel (or connection of rosbags), time ns and bytes."""
        raise NotImplementedError

    def _fast_batches(self, topics: Mapping[str, str]) -> Iterator[Batch] | None:
        """Return the messages as stored, in batches; None if the file has no fast reader."""
        return None

    def close(self) -> None:
        raise NotImplementedError

    def _scan(self) -> Iterator[tuple[int, int]]:
        """Yield channel number and time, ns, of every message."""
        raise NotImplementedError

    def _count(self) -> None:
        """Count the messages by a scan, for files whose index is missing or wrong."""
        counts: Counter[int] = Counter()
        start_ns, end_ns = 2**63 - 1, 0
        for number, time_ns in self._scan():
            counts[number] += 1
            start_ns, end_ns = min(start_ns, time_ns), max(end_ns, time_ns)
        self._set_counts(counts, start_ns, end_ns)

    def _set_counts(self, counts: Mapping[int, int], start_ns: int, end_ns: int) -> None:
        self.start_ns, self.end_ns = start_ns, end_ns
        self._channels = {number: replace(channel, count=counts.get(number, 0))
                          for number, channel in self._channels.items()}
        self.count = sum(channel.count for channel in self._channels.values())

    @property
    def channels(self) -> list[Channel]:
        return list(self._channels.values())

    def _channels_of(self, topics: Mapping[str, str]) -> dict[int, Channel]:
        return {number: channel for number, channel in self._channels.items()
                if topics.get(channel.topic) == channel.msgtype}


def is_valid_time(time_ns: int) -> bool:
    return isinstance(time_ns, int) and 0 <= time_ns < LATEST_NS


def in_batches(stream: Iterator[tuple[Any, ...]]) -> Iterator[Batch]:
    """Yield messages of a stream like ``BagFile.messages``, many at a time, by topic."""
    while batch := _next_batch(stream):
        yield batch


def _next_batch(stream: Iterator[tuple[Any, ...]]) -> Batch:
    """Return the next messages of a stream; {} at its end."""
    # lists of bytes and numbers only, which the garbage collector does not traverse (a list of
    # tuples takes as long as the reading itself)
    lists: dict[str, tuple[list[int], list[bytes]]] = {}
    messages_left, bytes_left = BATCH_MESSAGES, BATCH_BYTES
    for channel, time_ns, raw in stream:
        try:
            times, raws = lists[channel.topic]
        except KeyError:
            times, raws = lists[channel.topic] = [], []
        times.append(time_ns)
        raws.append(raw)
        messages_left -= 1
        bytes_left -= len(raw)
        if messages_left <= 0 or bytes_left <= 0:
            break
    return {topic: (np.array(times, np.int64), RawMessages.joined(raws))
            for topic, (times, raws) in lists.items()}


def group_overlapping(items: Iterable[Any]) -> Iterator[list[Any]]:
    """Yield groups of items that overlap in time; the items are in order of ``start_ns``."""
    group: list[Any] = []
    end_ns = 0
    for item in items:
        if group and item.start_ns >= end_ns:
            yield group
            group, end_ns = [], 0
        group.append(item)
        end_ns = max(end_ns, item.end_ns)
    yield group
