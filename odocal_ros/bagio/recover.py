"""What is left of bag files that rosbags cannot open: cut off, or with damage in the middle."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
import mmap
from pathlib import Path
import sqlite3
import struct
from typing import NamedTuple
import zlib

from odocal_ros.bagio.sources import zstd_module
from odocal_ros.bagio.sqlite_leaves import Leaves


@dataclass(frozen=True)
class Channel:
    """A topic of a bag file; ``definition`` is (format 'msg', 'idl' or '', text)."""

    topic: str
    msgtype: str
    count: int = 0
    serialization: str = 'cdr'
    definition: tuple[str, str] = ('', '')


class Message(NamedTuple):
    """One message as recorded: the first has the shape of what rosbags yields."""

    channel: Channel
    time_ns: int
    raw: bytes


FORMATS = {'ros2msg': 'msg', 'ros2idl': 'idl', 'omgidl': 'idl'}
MCAP_MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = range(2, 7)


class _Recovered:
    """Counts once what is there, then yields it as often as asked."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ''
        self.start_ns, self.end_ns, self.count = 2**63 - 1, 0, 0
        counts: Counter = Counter()
        for key, time_ns in self._scan():
            counts[key] += 1
            self.start_ns = min(self.start_ns, time_ns)
            self.end_ns = max(self.end_ns, time_ns)
        self.count = counts.total()
        self._channels = {key: replace(channel, count=counts[key])
                          for key, channel in self._channels.items()}

    _channels: dict[int, Channel]

    def _scan(self) -> Iterator[tuple[int, int]]:
        raise NotImplementedError

    @property
    def channels(self) -> list[Channel]:
        """Return the topics, each with the number of messages found."""
        return list(self._channels.values())

    def _wanted(self, topics: Mapping[str, str]) -> dict[int, Channel]:
        return {k: c for k, c in self._channels.items() if topics.get(c.topic) == c.msgtype}


class CutDatabase(_Recovered):
    """
    A sqlite3 bag read leaf page by leaf page.

    The inner pages that lead to a row are often written after it, so that in a file cut off SQL
    reaches little of what is there; the leaves of the table of messages hold it all.
    """

    def __init__(self, path: Path) -> None:
        db = sqlite3.connect(f'file:{_quoted(path)}?mode=ro&immutable=1', uri=True)
        # else sqlite refuses at once a file shorter than its header says
        db.execute('PRAGMA writable_schema=ON')
        definitions = self._definitions(db)
        self._channels = {
            key: Channel(topic, msgtype, 0, form, definitions.get(msgtype, ('', '')))
            for key, topic, msgtype, form in db.execute(
                'SELECT id, name, type, serialization_format FROM topics')}
        db.close()
        self._leaves = Leaves(path)
        super().__init__(path)
        self.damage = 'cut off' if self._leaves.cut else 'pages of it are damaged'

    @staticmethod
    def _definitions(db) -> dict[str, tuple[str, str]]:
        try:
            rows = db.execute('SELECT topic_type, encoding, encoded_message_definition '
                              'FROM message_definitions').fetchall()
        except sqlite3.DatabaseError:
            return {}
        return {msgtype: (FORMATS.get(form, ''), text) for msgtype, form, text in rows}

    def _scan(self):
        yield from ((key, time_ns) for key, time_ns, _ in self._leaves.rows(self._channels))

    def messages(self, topics: Mapping[str, str]) -> Iterator[Message]:
        """Yield the messages of some topics (name -> type) in the order they were written."""
        wanted = self._wanted(topics)
        for key, time_ns, raw in self._leaves.rows(wanted):
            yield Message(wanted[key], time_ns, raw)

    def close(self) -> None:
        """Let go of the file."""
        self._leaves.close()


class CutMcap(_Recovered):
    """An mcap file read record by record, without its index and to its last whole message."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('rb')
        self._map = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        self._schemas: dict[int, tuple[str, tuple[str, str]]] = {}
        self._channels = {}
        super().__init__(path)
        if self._map[-8:] != MCAP_MAGIC and not self.damage:
            self.damage = 'cut off'

    def _scan(self):
        yield from ((key, time_ns) for key, time_ns, _ in self._walk())

    def messages(self, topics: Mapping[str, str]) -> Iterator[Message]:
        """Yield the messages of some topics (name -> type), by time within each chunk."""
        wanted = self._wanted(topics)
        for key, time_ns, data in self._walk():
            if key in wanted:
                yield Message(wanted[key], time_ns, data)

    def _walk(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield channel, time and data of each message, chunk by chunk."""
        for op, body in self._records(self._map, len(MCAP_MAGIC)):
            if op == MESSAGE:
                yield _message(body)
            else:
                inner = self._records(self._unpacked(body), 0)
                yield from sorted((_message(record) for kind, record in inner if kind == MESSAGE),
                                  key=lambda message: message[1])

    def _records(self, data, at: int) -> Iterator[tuple[int, bytes]]:
        """Yield messages and chunks, the last chunk even if it is cut off; note the rest."""
        while at + 9 <= len(data) and data[at] != FOOTER:
            op, (size,) = data[at], struct.unpack_from('<Q', data, at + 1)
            whole = at + 9 + size <= len(data)
            if op in (SCHEMA, CHANNEL) and whole:
                self._learn(op, data[at + 9:at + 9 + size])
            elif op == CHUNK or op == MESSAGE and whole and size >= 22:
                yield op, data[at + 9:at + 9 + size]
            at += 9 + size

    def _learn(self, op: int, body: bytes) -> None:
        """Note a schema or a channel."""
        try:
            if op == SCHEMA:
                name, at = _text(body, 2)
                form, at = _text(body, at)
                text, _ = _text(body, at)
                self._schemas[_u16(body, 0)] = name, (FORMATS.get(form, ''), text)
            elif _u16(body, 0) not in self._channels:
                topic, at = _text(body, 4)
                form, _ = _text(body, at)
                name, definition = self._schemas.get(_u16(body, 2), ('', ('', '')))
                self._channels[_u16(body, 0)] = Channel(topic, name, 0, form, definition)
        except (struct.error, UnicodeDecodeError):
            self.damage = 'a damaged record'

    def _unpacked(self, body: bytes) -> bytes:
        """Return the records of a chunk, as many as came out whole; b'' if none."""
        try:
            size, crc = struct.unpack_from('<QI', body, 16)
            packing, at = _text(body, 28)
            records = _DECOMPRESS[packing](body[at + 8:])
        except Exception:   # each compression has its own error; what is lost is lost
            self.damage = 'a damaged chunk'
            return b''
        if crc and len(records) == size and zlib.crc32(records) != crc:
            self.damage = 'a damaged chunk'
            return b''
        return records

    def close(self) -> None:
        """Let go of the file."""
        self._map.close()
        self._file.close()


def _lz4(data: bytes) -> bytes:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
    return LZ4FrameDecompressor().decompress(data)


# decompressor objects give what came out of a stream that is cut off
_DECOMPRESS = {'': lambda data: data, 'lz4': _lz4,
               'zstd': lambda data: zstd_module().ZstdDecompressor().decompress(data)}


def _message(body: bytes) -> tuple[int, int, bytes]:
    key, _, time_ns = struct.unpack_from('<HIQ', body)
    return key, time_ns, body[22:]


def _u16(body: bytes, at: int) -> int:
    return struct.unpack_from('<H', body, at)[0]


def _text(body: bytes, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from('<I', body, at)
    return body[at + 4:at + 4 + size].decode(), at + 4 + size


def _quoted(path: Path) -> str:
    from urllib.parse import quote
    return quote(str(path.resolve()))
