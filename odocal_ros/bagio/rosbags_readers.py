# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What is read by the library rosbags: message types defined in a bag, and rosbag1 files.

Definitions and files are untrusted: time, size and number of elements are limited.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
import io
from pathlib import Path
import re
import signal
import threading
from typing import Any

from odocal_ros.bagio.bag_file import BagFile, Channel
from odocal_ros.bagio.known_types import KNOWN_DEFINITIONS
from odocal_ros.errors import BadBag, BadData, BadUsage, OdocalError, UndefinedType
from odocal_ros.safe_io import limits
from odocal_ros.safe_io.limits import Allowance, LATEST_NS, limit_factor, LimitReached

# format: line between two definitions, of ros2msg in mcap.dev/spec/registry
IDL_SEPARATOR = '=' * 80 + '\n'
# of IDL: string, comments, annotation, bracket, other text
TOKEN = re.compile(r'"(?:[^"\\\n]|\\.)*"|//[^\n]*|/\*.*?\*/|@\s*[\w:]+|[()]|[^"/@()]+|.',
                   re.DOTALL)
UNDEFINED_TYPE = (
    '{} is not a standard message type and the bag holds no definition of it; convert the bag '
    "to mcap with 'ros2 bag convert' where its package is installed, or use another topic")
# names of compressions in ``Allowance.unpack``, by those of rosbags
COMPRESSIONS = {'none': '', 'bz2': 'bz2', 'lz4': 'lz4'}


@contextmanager
def require_rosbags(user: str) -> Iterator[None]:
    """Raise BadUsage if an import in the block fails; ``user``: what needs rosbags, as text."""
    try:
        yield
    except ModuleNotFoundError:
        raise BadUsage(f'{user} needs the Python package rosbags, which is not installed: '
                       'pip install rosbags') from None


def parse_definition(msgtype: str, form: str, text: str) -> dict[str, Any]:
    """Return the fields of a type and of the types in it; form is 'msg' or 'idl'."""
    with require_rosbags('a non-standard message type'):
        from rosbags.typesys import get_types_from_idl, get_types_from_msg
    if form == 'msg':
        return get_types_from_msg(text, msgtype)
    definitions = [text]
    if text.startswith(f'{IDL_SEPARATOR}IDL: '):      # several, each after a line with its name
        definitions = [part.split('\n', 1)[1] for part in text.split(IDL_SEPARATOR)[1:]]
    types: dict[str, Any] = {}
    for definition in definitions:
        types.update(get_types_from_idl(strip_idl(definition)))
    return types


def strip_idl(text: str) -> str:
    """
    Return IDL without comments and annotations, which do not affect a layout and parse slowly.

    Raises ValueError for computed constants: messages have none, and 1 << 2**40 is large.
    """
    parts, depth, annotated = [], 0, False
    for token in TOKEN.findall(text):
        if depth:
            depth += (token == '(') - (token == ')')
        elif token.startswith('@'):
            annotated = True
        elif annotated and token == '(':
            depth, annotated = 1, False
        elif token.startswith(('//', '/*')):
            parts.append(' ')
        else:
            annotated = annotated and token.isspace()
            parts.append(token)
    plain = ''.join(parts)
    if '<<' in plain or '*' in plain:
        raise ValueError('computed constants')
    return plain


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError if the block runs longer; without effect outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def raise_timeout(*_: Any) -> None:
        raise TimeoutError(f'it takes longer than {seconds:g} s')
    previous_handler = signal.signal(signal.SIGALRM, raise_timeout)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous_handler)


class Types:
    """Deserialises messages of standard, known and bag-defined types, by rosbags."""

    def __init__(self) -> None:
        self._store: Any = None
        self._definitions: dict[str, tuple[str, str]] = {}      # of the bag

    def define(self, msgtype: str, definition: tuple[str, str]) -> None:
        """Store the definition of a type, (form, text); it is parsed when it is needed."""
        if definition[0]:
            self._definitions.setdefault(msgtype, definition)

    def deserializer(self, msgtype: str) -> Callable[[bytes], Any]:
        """Return a function that converts CDR bytes of a type to an object."""
        def deserialize(raw: bytes) -> Any:
            store = self._typestore_for(msgtype)
            try:
                return store.deserialize_cdr(raw, msgtype)
            except Exception:
                # bytes after the message, as left by rclpy's serialize_message, are allowed
                if raw[:2] != b'\x00\x01':
                    raise
                kind = store.get_msgdef(msgtype)
                return kind.deserialize_cdr_le(raw[4:], 0, kind.cls, store)[0]
        return deserialize

    def cdr_from_ros1(self, raw: bytes, connection: Any) -> bytes:
        cdr: bytes = self._typestore_for(connection.msgtype).ros1_to_cdr(raw, connection.msgtype)
        return cdr

    def _typestore_for(self, msgtype: str) -> Any:
        if self._store is None:
            with require_rosbags(msgtype):
                from rosbags.typesys import get_typestore, Stores
            self._store = get_typestore(Stores.ROS2_JAZZY)
        if msgtype not in self._store.fielddefs:
            self._register(msgtype)
        return self._store

    def _register(self, msgtype: str) -> None:
        known = ('msg', KNOWN_DEFINITIONS[msgtype]) if msgtype in KNOWN_DEFINITIONS else ('', '')
        form, text = self._definitions.get(msgtype, known)
        if not form:
            raise UndefinedType(UNDEFINED_TYPE.format(msgtype))
        limits.check(len(text), limits.DEFINITION_CHARACTERS,
                     f'{msgtype}: its definition in the bag', 'characters')
        try:
            with time_limit(limits.PARSE_SECONDS * limit_factor()):
                known_types = self._store.fielddefs
                new_types = {name: fields for name, fields in parse_definition(
                    msgtype, form, text).items() if name not in known_types}
                limits.check(_count_elements(msgtype, known_types | new_types),
                             limits.MESSAGE_VALUES, f'{msgtype}: a message', 'values')
                self._store.register(new_types)
        except (MemoryError, LimitReached):
            raise
        except Exception as error:   # a parser's errors
            cause = ' '.join(str(error).split())[:100] or type(error).__name__
            raise BadData(f'{msgtype}: its definition in the bag cannot be parsed ({cause}); use '
                          'another topic') from None


def _count_elements(msgtype: str, fielddefs: dict[str, Any], depth: int = 0) -> int:
    """Return the smallest number of values of a message; fielddefs : definitions of rosbags."""
    max_depth = 50    # of messages in messages
    if depth > max_depth:
        raise ValueError('it contains itself')

    def count_of(field_type: tuple[Any, Any]) -> int:
        kind, details = field_type
        if kind.name == 'NAME':      # another message type
            return _count_elements(details, fielddefs, depth + 1)
        if kind.name == 'ARRAY':
            element_type, length = details
            return count_of(element_type) * int(length)
        return 1
    total = 0
    for _, field_type in fielddefs[msgtype][1]:
        total += count_of(field_type)
        if total > limits.MESSAGE_VALUES * limit_factor():
            break
    return total


class Rosbag1File(BagFile):
    """
    A file of ROS 1; ``convert`` returns a message of a connection as CDR.

    rosbags allocates the sizes that the file states for index and chunks. Here the bytes read for
    the index are counted, and its decompressors are replaced by limited ones.
    """

    def __init__(self, path: Path, allowance: Allowance, convert: Callable[..., Any]) -> None:
        super().__init__(path, allowance)
        self._convert = convert
        try:
            self._reader = self._open(path)
        except (PermissionError, MemoryError, BadBag):
            raise
        except Exception as error:   # rosbags and its dependencies raise many exceptions
            raise self._unreadable(error) from None
        connections = self._reader.connections
        self._channels = {c.id: Channel(c.topic, c.msgtype, c.msgcount, 'ros1', (
            c.msgdef.format.name.lower(), c.msgdef.data)) for c in connections}
        self.count = sum(c.msgcount for c in connections)
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        if self.count and not 0 <= self.start_ns <= self.end_ns < LATEST_NS:
            raise self._unreadable(ValueError('invalid start or end time'))

    def _open(self, path: Path) -> Any:
        """Return the opened reader of rosbags, with limited decompressors."""
        reader = _limited_reader(path)
        reader.open()
        from rosbags.rosbag1.reader import decompressors
        names = {function: name for name, function in decompressors.items()}
        for position, chunk in reader.chunks.items():
            reader.chunks[position] = chunk._replace(decompressor=partial(
                self._allowance.unpack, COMPRESSIONS[names[chunk.decompressor]]))
        return reader

    def _unreadable(self, error: Exception) -> BadBag:
        # an error of rosbags may contain the one that it is raised from, as a tuple
        cause = ' '.join(str(error.__cause__ or error).split()).rstrip('.')[:200]
        cause = cause if ' ' in cause else 'damaged records'      # one word says nothing
        return BadBag(f"{self.path}: cannot be read ({cause}); try 'rosbag reindex' on it")

    def messages(self, topics: Mapping[str, str]) -> Iterator[tuple[Any, ...]]:
        """Yield the messages of some topics (name -> type) by time, as CDR."""
        connections = [c for c in self._reader.connections if topics.get(c.topic) == c.msgtype]
        if not connections:      # for rosbags an empty list means all
            return
        self._allowance.restart()
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


def _limited_reader(path: Path) -> Any:
    """Return a reader of rosbags whose index is limited to the size of the file."""
    with require_rosbags('a rosbag1 file'):
        from rosbags.rosbag1 import Reader
    file_size = path.stat().st_size

    class LimitedFile(io.BufferedReader):
        """File whose reads are limited to the size of the file."""

        def read(self, size: int | None = -1) -> bytes:
            return super().read(min(size, file_size) if size and size > 0 else size)

    class LimitedPath(type(Path())):     # type: ignore[misc]
        """A path that opens a LimitedFile."""

        def open(self, *_: str) -> io.BufferedReader:
            return LimitedFile(io.FileIO(self))

    class LimitedReader(Reader):
        """Reader that limits the bytes read for the index."""

        bytes_left = file_size

        def read_index_data(self, pos: int, indexes: Any) -> None:
            assert self.bio
            begin = self.bio.tell()
            super().read_index_data(pos, indexes)
            self.bytes_left -= self.bio.tell() - begin
            if self.bytes_left < 0:
                raise ValueError('its index contains a cycle')
    return LimitedReader(LimitedPath(path))
