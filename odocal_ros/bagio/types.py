# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Message types of a bag: the standard ones, and others from its definitions, in bounded time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import re
import signal
import threading
from typing import Any

from odocal_ros.errors import BadData, BadUsage
from odocal_ros.safe_io.limits import check, DEFINITION, ELEMENTS, factor, LimitReached, SECONDS

BAR = '=' * 80 + '\n'    # format: between definitions, of ros2msg in mcap.dev/spec/registry
TOKEN = re.compile(r'"(?:[^"\\\n]|\\.)*"|//[^\n]*|/\*.*?\*/|@\s*[\w:]+|[()]|[^"/@()]+|.',
                   re.DOTALL)


@contextmanager
def rosbags_for(what: str) -> Iterator[None]:
    """Raise BadUsage if an import of rosbags, which is optional, fails; ``what`` needs it."""
    try:
        yield
    except ModuleNotFoundError:
        raise BadUsage(f'{what} needs the Python package rosbags, which is not installed: '
                       'pip install rosbags') from None


def parsed(msgtype: str, form: str, text: str) -> dict[str, Any]:
    """Return the fields of a type and of the types in it; form is 'msg' or 'idl'."""
    with rosbags_for('a non-standard message type'):
        from rosbags.typesys import get_types_from_idl, get_types_from_msg
    if form == 'msg':
        return get_types_from_msg(text, msgtype)
    parts = [part.split('\n', 1)[1] for part in text.split(BAR)[1:]] if text.startswith(
        f'{BAR}IDL: ') else [text]
    found: dict[str, Any] = {}
    for part in parts:
        found.update(get_types_from_idl(bare(part)))
    return found


def bare(text: str) -> str:
    """
    Return IDL without comments and annotations, which do not affect a layout and parse slowly.

    Raises ValueError for computed constants: messages have none, and 1 << 2**40 is large.
    """
    kept, depth, annotated = [], 0, False
    for token in TOKEN.findall(text):
        if depth:
            depth += (token == '(') - (token == ')')
        elif token.startswith('@'):
            annotated = True
        elif annotated and token == '(':
            depth, annotated = 1, False
        elif token.startswith(('//', '/*')):
            kept.append(' ')
        else:
            annotated = annotated and token.isspace()
            kept.append(token)
    plain = ''.join(kept)
    if '<<' in plain or '*' in plain:
        raise ValueError('computed constants')
    return plain


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise TimeoutError if the block runs longer; only has an effect in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(*_: Any) -> None:
        raise TimeoutError(f'it takes longer than {seconds:g} s')
    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class Types:
    """Deserialises messages; a type is loaded with its first message."""

    def __init__(self) -> None:
        self._store: Any = None
        self._definitions: dict[str, tuple[str, str]] = {}

    def define(self, msgtype: str, definition: tuple[str, str]) -> None:
        if definition[0]:
            self._definitions.setdefault(msgtype, definition)

    def deserializer(self, msgtype: str) -> Callable[[bytes], Any]:
        """Return a function that converts CDR bytes of a type to an object."""
        def deserialize(raw: bytes) -> Any:
            store = self._with(msgtype)
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
        cdr: bytes = self._with(connection.msgtype).ros1_to_cdr(raw, connection.msgtype)
        return cdr

    def _with(self, msgtype: str) -> Any:
        if self._store is None:
            with rosbags_for(msgtype):
                from rosbags.typesys import get_typestore, Stores
            self._store = get_typestore(Stores.ROS2_JAZZY)
        if msgtype not in self._store.fielddefs:
            self._register(msgtype)
        return self._store

    def _register(self, msgtype: str) -> None:
        form, text = self._definitions.get(msgtype, ('', ''))
        if not form:
            raise BadData(f'{msgtype} is not a standard message type and the bag holds no '
                          'definition of it: record with a current rosbag2 (mcap), or use '
                          'another topic')
        check(len(text), DEFINITION, f'{msgtype}: its definition in the bag', 'characters')
        try:
            with within(SECONDS * factor()):
                known = self._store.fielddefs
                found = {name: fields for name, fields in parsed(msgtype, form, text).items()
                         if name not in known}
                check(_elements(msgtype, known | found), ELEMENTS, f'{msgtype}: a message',
                      'values')
                self._store.register(found)
        except (MemoryError, LimitReached):
            raise
        except Exception as error:   # a parser's errors
            why = ' '.join(str(error).split())[:100] or type(error).__name__
            raise BadData(f'{msgtype}: its definition in the bag cannot be parsed ({why}); use '
                          'another topic') from None


def _elements(msgtype: str, fielddefs: dict[str, Any], depth: int = 0) -> int:
    """Return the minimum number of values in the fixed arrays of a message."""
    deepest = 50    # largest nesting of messages
    if depth > deepest:
        raise ValueError('it contains itself')

    def of(field: tuple[Any, Any]) -> int:
        kind, what = field
        if kind.name == 'NAME':
            return _elements(what, fielddefs, depth + 1)
        return of(what[0]) * int(what[1]) if kind.name == 'ARRAY' else 1
    total = 0
    for _, field in fielddefs[msgtype][1]:
        total += of(field)
        if total > ELEMENTS * factor():
            break
    return total
