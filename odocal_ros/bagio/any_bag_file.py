# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One file of a bag, of any kind: its messages as CDR, in batches."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
import heapq
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.bagio.bag_file import BagFile, Batch, Channel
from odocal_ros.bagio.mcap_file import McapFile
from odocal_ros.bagio.rosbags_readers import Rosbag1File
from odocal_ros.bagio.sqlite_file import SqliteFile
from odocal_ros.errors import BadBag
from odocal_ros.messages.raws import RawMessages
from odocal_ros.safe_io.limits import Allowance, Damaged, LimitReached

BLOCK = 20_000         # judgement: messages in a batch
ZSTD = b'\x28\xb5\x2f\xfd'


class AnyBagFile:
    """
    The messages of one file of a bag in any format, each message decompressed.

    path : the user's file, for errors.   file, kind : the unpacked file and its format, from
    ``sources.unpack``.   total : size of the whole bag, bytes.   convert : ROS 1 message to CDR.
    """

    def __init__(self, path: Path, file: Path, kind: str, total: int,
                 convert: Callable[..., Any]) -> None:
        self.path = path
        self._allowance = Allowance(path, total)
        try:
            self._file: BagFile = (
                McapFile(file, self._allowance) if kind == '.mcap' else
                SqliteFile(file) if kind == '.db3' else
                Rosbag1File(file, self._allowance, convert))
        except (Damaged, ValueError) as error:
            raise BadBag(f'{path}: cannot be read ({error})') from None

    def __getattr__(self, name: str) -> Any:
        """Return the metadata of the file: channels, damage, count, start_ns, end_ns."""
        return getattr(self.__dict__['_file'], name)

    def batches(self, topics: Mapping[str, str]) -> Iterator[Batch]:
        """Yield the messages of some topics (name -> type), many at a time, as CDR."""
        batches = self._file.batches(topics)     # None: the format has no fast reader
        first = next(batches, {}) if batches else {}
        if batches and not any(_is_compressed(raws[0]) for _, raws in first.values()):
            yield from chain([first] * bool(first), batches)
            return
        del batches
        stream = self._messages(topics)
        while batch := next_batch(stream):
            yield batch

    def stream(self, topics: Mapping[str, str]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield the messages one by one in order of time, for merging; slower."""
        channels = {c.topic: c for c in self.channels}
        for batch in self.batches(topics):
            lists = ([(time_ns, i, channels[topic], raw) for i, (time_ns, raw) in enumerate(
                zip(times.tolist(), raws, strict=True))] for topic, (times, raws) in batch.items())
            for time_ns, _, channel, raw in heapq.merge(*lists, key=itemgetter(0)):
                yield channel, time_ns, raw

    def _messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Return the messages (connection or Channel, time, raw), decompressed."""
        stream: Iterator[tuple[Any, ...]] = self._file.messages(topics)
        first = next(stream, None)
        if first is None:
            return iter(())
        stream = chain([first], stream)
        return self._unpacked(stream) if _is_compressed(first[2]) else stream

    def _unpacked(self, stream: Iterator[tuple[Any, ...]]) -> Iterator[tuple[Any, ...]]:
        """Yield messages unpacked; b'' if that fails, which readers count as unreadable."""
        for channel, time_ns, raw in stream:
            try:
                raw = self._allowance.unpack('zstd', raw)
            except (LimitReached, MemoryError):
                raise
            except Exception:   # a damaged message
                raw = b''
            yield channel, time_ns, raw

    def close(self) -> None:
        with suppress(Exception):
            self._file.close()


def _is_compressed(raw: bytes) -> bool:
    """Return True if each message is compressed separately: CDR starts with a zero byte."""
    return raw[:4] == ZSTD


def next_batch(stream: Iterator[tuple[Any, ...]]) -> Batch:
    """Return the next messages (connection or Channel, time, raw) by topic; {} at the end."""
    # lists of bytes and numbers only, which the garbage collector does not traverse (a list of
    # tuples takes as long as the reading itself)
    found: dict[str, tuple[list[int], list[bytes]]] = {}
    messages, size = BLOCK, 2**24      # bytes of them
    for channel, time_ns, raw in stream:
        try:
            times, raws = found[channel.topic]
        except KeyError:
            times, raws = found[channel.topic] = [], []
        times.append(time_ns)
        raws.append(raw)
        messages -= 1
        size -= len(raw)
        if messages <= 0 or size <= 0:
            break
    return {topic: (np.array(times, np.int64), RawMessages.of(raws))
            for topic, (times, raws) in found.items()}
