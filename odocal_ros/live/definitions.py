# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Message classes by name, and their definitions for the journal."""

import importlib
from importlib.machinery import PathFinder
from pathlib import Path
import re
from typing import Any

from odocal_ros.errors import BadConfig

MESSAGE_TYPE = re.compile(r'(?P<package>[a-z][a-z0-9_]*)/msg/(?P<name>[A-Z][A-Za-z0-9]*)')
NAMES = {'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64'}
KIND = re.compile(r'(sequence<)?([\w/]+)(<\d+>)?(?:, (\d+))?(>)?(\[\d+\])?')


def message_class(msgtype: str) -> Any:
    """Return the class of 'pkg/msg/Type', or raise BadConfig with what to do."""
    match = MESSAGE_TYPE.fullmatch(msgtype)     # somebody on the net may have chosen it
    try:
        if match is None or not _has_messages(match['package']):
            raise ImportError
        return getattr(importlib.import_module(f'{match["package"]}.msg'), match['name'])
    except (ImportError, AttributeError):
        raise BadConfig(
            f'message type {msgtype!r} cannot be imported here: install its package or source '
            f"its workspace ('ros2 interface show {msgtype}' must work), or correct the type"
        ) from None


def _has_messages(package: str) -> bool:
    """Return True if a package has messages, without importing it."""
    found = PathFinder.find_spec(package)
    places = found and found.submodule_search_locations or ()
    return any(Path(place, 'msg').is_dir() for place in places)


def definition_of(kind: type) -> str:
    """
    Return the definition of a message class as a bag holds it: its .msg text and those it uses.

    Constants and defaults, which the classes do not have, are not in it; the bytes of a message
    do not depend on them.
    """
    texts: dict[str, str] = {}
    _collect(kind, '', texts)
    first, *others = texts.items()
    return first[1] + ''.join(f'{"=" * 80}\nMSG: {name}\n{text}' for name, text in others)


def _collect(kind: Any, name: str, texts: dict[str, str]) -> None:
    """Add the text of a class and of all that it uses."""
    lines, used = [], []
    for field, about in kind.get_fields_and_field_types().items():
        base, whole = _in_msg(about)
        lines.append(f'{whole} {field}\n')
        used += [base] if '/' in base else []
    texts[name] = ''.join(lines)
    for base in used:
        if base not in texts:
            package, _, leaf = base.rpartition('/')
            _collect(getattr(importlib.import_module(f'{package}.msg'), leaf), base, texts)


def _in_msg(about: str) -> tuple[str, str]:
    """Return the base type, and the field's type, as a .msg file has them."""
    match = KIND.fullmatch(about)
    if match is None:
        raise ValueError(f'a field of type {about}')
    sequence, base, bound, most, _, array = match.groups()
    base = NAMES.get(base, base)
    text = base + (f'<={bound[1:-1]}' if bound else '')
    if sequence:
        return base, f'{text}[<={most}]' if most else f'{text}[]'
    return base, text + (array or '')
