"""One file of a bag: through rosbags where it can, else by what can be recovered."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
import heapq
from itertools import chain, islice
from operator import itemgetter
from pathlib import Path
import sqlite3
from typing import Any

from odocal_ros.bagio.recover import Channel, CutDatabase, CutMcap
from odocal_ros.bagio.sources import zstd_module
from odocal_ros.errors import BadBag, BadData

BLOCK = 20_000         # messages taken at a time
ZSTD = b'\x28\xb5\x2f\xfd'
# topic -> bag times and messages, in order of arrival; lists of bytes and numbers only, which
# the garbage collector does not look at (a list of tuples takes as long as the reading itself)
Batch = dict[str, tuple[list[int], list[bytes]]]


class Part:
    """
    A file of a bag.

    ``damage`` says what is wrong with it, empty if nothing is; found while reading, it is told
    only after that.
    """

    def __init__(self, path: Path, file: Path, kind: str, convert: Callable) -> None:
        self.path, self.damage = path, ''
        self._file, self._kind, self._convert = file, kind, convert
        self._reader: Any = None
        self._recovered: CutMcap | CutDatabase | None = None
        try:
            self._reader = _rosbags_reader(file, kind)
            self._reader.open()
            self.channels = [_channel(c) for c in self._reader.connections]
            self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
            self.count = self._reader.message_count
        except PermissionError:
            raise
        except Exception as error:   # rosbags and what it stands on fail in many ways
            self._recover(error)

    def _recover(self, error: Exception) -> None:
        """Go on with what can be recovered, or raise BadBag."""
        why = ' '.join(str(error).split()).rstrip('.') or type(error).__name__
        if self._kind == '.bag':
            raise BadBag(f"{self.path}: cannot be read ({why}); try 'rosbag reindex' on it")
        try:
            found = (CutMcap if self._kind == '.mcap' else CutDatabase)(self._file)
        except (sqlite3.DatabaseError, ValueError) as second:
            raise BadBag(f'{self.path}: nothing in it can be read ({why}; {second})') from None
        self._recovered = found
        self.damage = found.damage
        self.channels, self.count = found.channels, found.count
        self.start_ns, self.end_ns = found.start_ns, found.end_ns

    def batches(self, topics: Mapping[str, str]) -> Iterator[Batch]:
        """Yield the messages of some topics (name -> type), many at a time, as CDR."""
        stream, given = self._messages(topics), 0
        while True:
            batch: Batch = {}
            failed = None
            try:
                group(islice(stream, BLOCK), batch)   # keeps what came before an error
            except BadData:
                raise
            except Exception as error:   # damage in the middle of the file
                failed = error
            given += sum(len(raws) for _, raws in batch.values())
            if batch:
                yield batch
            if failed is not None:
                if self._recovered:
                    raise BadBag(f'{self.path}: cannot be read ({failed})') from failed
                self._recover(failed)
                stream = islice(self._messages(topics), given, None)
            elif not batch:
                return

    def stream(self, topics: Mapping[str, str]) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield the same one by one in order of time, for merging; slower."""
        channels = {c.topic: c for c in self.channels}
        for batch in self.batches(topics):
            lists = ([(time_ns, i, channels[topic], raw) for i, (time_ns, raw) in
                      enumerate(zip(*both, strict=True))] for topic, both in batch.items())
            for time_ns, _, channel, raw in heapq.merge(*lists, key=itemgetter(0)):
                yield channel, time_ns, raw

    def _messages(self, topics: Mapping[str, str]) -> Iterator[tuple]:
        if self._recovered:
            stream: Iterator[tuple] = self._recovered.messages(topics)
        else:
            connections = [c for c in self._reader.connections
                           if topics.get(c.topic) == c.msgtype]
            if not connections:      # rosbags would take none as all
                return iter(())
            stream = self._reader.messages(connections=connections)
        first = next(stream, None)
        if first is None:
            return iter(())
        stream = chain([first], stream)
        if self._kind == '.bag':
            return _each(stream, self._convert)
        if first[2][:4] == ZSTD:     # each message compressed; CDR begins with a zero byte
            decompress = zstd_module().decompress
            return _each(stream, lambda raw, _: decompress(raw))
        return stream

    def close(self) -> None:
        """Let go of the file."""
        for opened in (self._reader, self._recovered):
            if opened is not None:
                with suppress(Exception):    # rosbags: 'not open' after a failed opening
                    opened.close()


def group(stream, batch: Batch) -> None:
    """Sort messages (rosbags' connection or our Channel, time, raw) by topic into a batch."""
    for channel, time_ns, raw in stream:
        try:
            times, raws = batch[channel.topic]
        except KeyError:
            times, raws = batch[channel.topic] = [], []
        times.append(time_ns)
        raws.append(raw)


def _each(stream, convert):
    """Yield messages with their bytes converted; b'' where that fails, for readers to count."""
    for channel, time_ns, raw in stream:
        try:
            raw = bytes(convert(raw, channel))
        except BadData:
            raise
        except Exception:   # a damaged message
            raw = b''
        yield channel, time_ns, raw


def _rosbags_reader(file: Path, kind: str):
    from rosbags import rosbag1, rosbag2
    return rosbag1.Reader(file) if kind == '.bag' else rosbag2.Reader(file)


def _channel(connection) -> Channel:
    form = connection.msgdef.format.name.lower()
    return Channel(connection.topic, connection.msgtype, connection.msgcount,
                   getattr(connection.ext, 'serialization_format', 'cdr'),
                   ('' if form == 'none' else form, connection.msgdef.data))

