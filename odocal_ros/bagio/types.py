# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Message types of a bag: the standard ones, and others from the definitions in the bag."""

from collections.abc import Callable
from typing import Any

from odocal_ros.bagio.definitions import parsed, rosbags_for, within
from odocal_ros.errors import BadData
from odocal_ros.outside.limits import check, DEFINITION, ELEMENTS, factor, LimitReached, SECONDS


class Types:
    """Deserialises messages; a type is looked up when its first message is."""

    def __init__(self) -> None:
        self._store: Any = None
        self._definitions: dict[str, tuple[str, str]] = {}

    def define(self, msgtype: str, definition: tuple[str, str]) -> None:
        """Remember a definition ('msg' or 'idl', text) that a bag holds."""
        if definition[0]:
            self._definitions.setdefault(msgtype, definition)

    def deserializer(self, msgtype: str) -> Callable[[bytes], Any]:
        """Return the function that turns CDR bytes of a type into an object."""
        def deserialize(raw: bytes) -> Any:
            store = self._with(msgtype)
            try:
                return store.deserialize_cdr(raw, msgtype)
            except Exception:
                # bytes behind the message, as rclpy's serialize_message leaves them, are no fault
                if raw[:2] != b'\x00\x01':
                    raise
                kind = store.get_msgdef(msgtype)
                return kind.deserialize_cdr_le(raw[4:], 0, kind.cls, store)[0]
        return deserialize

    def cdr_from_ros1(self, raw: bytes, connection: Any) -> bytes:
        """Return a ROS 1 message as CDR."""
        cdr: bytes = self._with(connection.msgtype).ros1_to_cdr(raw, connection.msgtype)
        return cdr

    def _with(self, msgtype: str) -> Any:
        """Return the store once it knows a type, or raise BadData."""
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
    deepest = 50    # of messages in messages
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
