"""Message types of a bag: the standard ones, and others from the definitions in the bag."""

from collections.abc import Callable
from typing import Any

from odocal_ros.errors import BadData


class Types:
    """Deserialises messages; a type is looked up when its first message is."""

    def __init__(self) -> None:
        self._store: Any = None
        self._definitions: dict[str, tuple[str, str]] = {}

    def define(self, msgtype: str, definition: tuple[str, str]) -> None:
        """Remember a definition ('msg' or 'idl', text) that a bag holds."""
        if definition[0]:
            self._definitions.setdefault(msgtype, definition)

    def deserializer(self, msgtype: str) -> Callable[[bytes], object]:
        """Return the function that turns CDR bytes of a type into an object."""
        def deserialize(raw: bytes) -> object:
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

    def cdr_from_ros1(self, raw: bytes, connection) -> bytes:
        """Return a ROS 1 message as CDR."""
        return self._with(connection.msgtype).ros1_to_cdr(raw, connection.msgtype)

    def _with(self, msgtype: str):
        """Return the store once it knows a type, or raise BadData."""
        if self._store is None:
            from rosbags.typesys import get_typestore, Stores
            self._store = get_typestore(Stores.ROS2_JAZZY)
        if msgtype not in self._store.fielddefs:
            self._register(msgtype)
        return self._store

    def _register(self, msgtype: str) -> None:
        from rosbags.typesys import get_types_from_msg
        form, text = self._definitions.get(msgtype, ('', ''))
        if not form:
            raise BadData(f'{msgtype} is no standard message type and the bag holds no definition '
                          'of it: record with a current rosbag2 (mcap), or use another topic')
        try:
            found = get_types_from_msg(text, msgtype) if form == 'msg' else _from_idl(text)
            self._store.register({name: fields for name, fields in found.items()
                                  if name not in self._store.fielddefs})
        except Exception as error:   # a parser's errors
            why = ' '.join(str(error).split())[:100]
            raise BadData(f"{msgtype}: the bag's definition of it cannot be understood ({why}); "
                          'use another topic') from None


def _from_idl(text: str) -> dict:
    from rosbags.typesys import get_types_from_idl
    bar = '=' * 80 + '\n'
    if not text.startswith(f'{bar}IDL: '):
        return get_types_from_idl(text)
    found: dict = {}
    for part in text.split(bar)[1:]:
        found.update(get_types_from_idl(part.split('\n', 1)[1]))
    return found
