# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fields of messages by their path, for messages as bytes (a layout) or as objects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
import re
from typing import Any, Protocol

import numpy as np

from odocal_ros.data.arrays import Ints

PART = re.compile(r'\.?([^.\[\]]+)|\[([^\]]+)\]')


class View(Protocol):
    """Message as seen by a column: its joint names and the lengths of its lists."""

    @property
    def names(self) -> Sequence[str]:
        """Return the list ``name`` (of joints), empty if there is none."""

    def count(self, path: str) -> int:
        """Return the length of a list, 0 if it is missing."""


class MessageView:
    """A deserialised message, of rosbags or rclpy."""

    def __init__(self, message: object) -> None:
        self.message = message

    @property
    def names(self) -> Sequence[str]:
        """Return the list ``name`` (of joints), empty if there is none."""
        return list(getattr(self.message, 'name', ()))

    def count(self, path: str) -> int:
        """Return the length of a list, 0 if it is missing."""
        try:
            return len(self.value(path))
        except (AttributeError, LookupError, TypeError):
            return 0

    def value(self, path: str) -> Any:
        """
        Return the value at a dotted path, with [i] in a list or [name] by the list ``name``.

        Raises AttributeError, LookupError: it is missing.
        """
        here: Any = self.message
        owner = here
        for name, key in parts(path):
            if name:
                here, owner = getattr(here, name), here
            else:
                here = here[self._index(owner, key)]
        return here

    @staticmethod
    def _index(owner: object, key: str) -> int:
        names = list(getattr(owner, 'name', ()))
        if key in names:
            return names.index(key)
        if key.isdigit():
            return int(key)
        raise LookupError(f'no {key!r} among {", ".join(map(str, names)) or "no names"}')

    def fields(self) -> list[str]:
        """Return the names of the message's fields, for error messages."""
        given = getattr(type(self.message), '__dataclass_fields__', None)
        if given is None and hasattr(self.message, 'get_fields_and_field_types'):
            given = self.message.get_fields_and_field_types()
        return [name for name in (given or ()) if not name.startswith('__')]


@lru_cache
def parts(path: str) -> tuple[tuple[str, str], ...]:
    """Return a path as (name, '') and ('', key) pairs; empty if it is not a path."""
    found = tuple(PART.findall(path))
    whole = ''.join(f'[{key}]' if key else f'.{name}' for name, key in found)
    return found if whole.lstrip('.') == path else ()


@dataclass(frozen=True)
class Column:
    """
    Values to read from every message.

    ``pick`` returns their paths in a message, None if they are missing.
    """

    dtype: type
    width: int
    pick: Callable[[View], Sequence[str] | None]

    def of_message(self, view: MessageView) -> list[Any] | None:
        values = [view.value(path) for path in self.pick(view) or ()]
        if self.dtype is np.int64:
            values = [(int(v) + 2**63) % 2**64 - 2**63 for v in values]   # uint64 as int64 bits
        return values or None


def fixed(dtype: type, *paths: str) -> Column:
    """Return a column whose values have the same paths in every message."""
    return Column(dtype, len(paths), lambda view: paths)


def xyz(prefix: str, names: str = 'xyz') -> Column:
    return fixed(np.float64, *(f'{prefix}.{name}' for name in names))


def array(path: str, *indices: int) -> Column:
    return fixed(np.float64, *(f'{path}[{i}]' for i in indices))


STAMP = (fixed(np.int64, 'header.stamp.sec'), fixed(np.int64, 'header.stamp.nanosec'))


def stamp_ns(sec: Ints, nanosec: Ints) -> Ints:
    """Return header stamps in nanoseconds from the two columns of STAMP."""
    return sec[:, 0] * 10**9 + nanosec[:, 0]
