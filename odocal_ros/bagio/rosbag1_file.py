# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A rosbag1 file, read by rosbags, with limits on the sizes stated in its index and chunks."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
import io
from pathlib import Path
from typing import Any

from odocal_ros.bagio.channels import Channel, Recording
from odocal_ros.bagio.types import rosbags_for
from odocal_ros.errors import BadBag, OdocalError
from odocal_ros.safe_io.limits import Allowance, LATEST_NS, LimitReached

PACKINGS = {'none': '', 'bz2': 'bz2', 'lz4': 'lz4'}


class Rosbag1File(Recording):
    """
    A file of ROS 1.

    rosbags allocates the sizes that the file states for index and chunks. Here the bytes read for
    the index are counted, and its decompressors are replaced by limited ones.
    """

    def __init__(self, path: Path, allowance: Allowance, convert: Callable[..., Any]) -> None:
        super().__init__(path)
        self._convert, self._allowance = convert, allowance
        try:
            self._reader = self._opened(path)
        except (PermissionError, MemoryError, BadBag):
            raise
        except Exception as error:   # rosbags and its dependencies raise many exceptions
            raise self._unreadable(error) from None
        found = self._reader.connections
        self._channels = {c.id: Channel(c.topic, c.msgtype, c.msgcount, 'ros1', (
            c.msgdef.format.name.lower(), c.msgdef.data)) for c in found}
        self.count = sum(c.msgcount for c in found)
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        if self.count and not 0 <= self.start_ns <= self.end_ns < LATEST_NS:
            raise self._unreadable(ValueError('invalid start or end time'))

    def _opened(self, path: Path) -> Any:
        reader = _reader(path)
        reader.open()
        from rosbags.rosbag1.reader import decompressors
        names = {known: name for name, known in decompressors.items()}
        for at, chunk in reader.chunks.items():
            reader.chunks[at] = chunk._replace(decompressor=partial(
                self._allowance.unpack, PACKINGS[names[chunk.decompressor]]))
        return reader

    def _unreadable(self, error: Exception) -> BadBag:
        # an error of rosbags may contain the one that it is raised from, as a tuple
        why = ' '.join(str(error.__cause__ or error).split()).rstrip('.')[:200]
        why = why if ' ' in why else 'damaged records'      # a key, or nothing
        return BadBag(f"{self.path}: cannot be read ({why}); try 'rosbag reindex' on it")

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Yield the messages of some topics (name -> type) by time, as CDR."""
        connections = [c for c in self._reader.connections if topics.get(c.topic) == c.msgtype]
        if not connections:      # for rosbags an empty list means all
            return
        self._allowance.again()
        stream = self._reader.messages(connections=connections)
        while True:
            try:
                channel, time_ns, raw = next(stream)
            except StopIteration:
                return
            except (MemoryError, LimitReached):
                raise
            except Exception as error:
                raise self._unreadable(error) from None
            try:
                raw = bytes(self._convert(raw, channel))
            except (OdocalError, MemoryError):
                raise
            except Exception:   # a damaged message: readers count it
                raw = b''
            yield channel, time_ns, raw

    def close(self) -> None:
        self._reader.close()


def _reader(path: Path) -> Any:
    """Return a reader of rosbags whose index is limited to the size of the file."""
    with rosbags_for('a rosbag1 file'):
        from rosbags.rosbag1 import Reader
    most = path.stat().st_size

    class Bounded(io.BufferedReader):
        """File whose reads are limited to the size of the file."""

        def read(self, size: int | None = -1) -> bytes:
            return super().read(min(size, most) if size and size > 0 else size)

    class File(type(Path())):     # type: ignore[misc]
        """A path that opens a Bounded file."""

        def open(self, *_: str) -> io.BufferedReader:
            return Bounded(io.FileIO(self))

    class Counted(Reader):
        """Reader that limits the bytes read for the index."""

        left = most

        def read_index_data(self, pos: int, indexes: Any) -> None:
            assert self.bio
            begin = self.bio.tell()
            super().read_index_data(pos, indexes)
            self.left -= self.bio.tell() - begin
            if self.left < 0:
                raise ValueError('its index contains a cycle')
    return Counted(File(path))
