# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors raised on purpose; commands and nodes catch OdocalError once and show its sentence."""

from collections.abc import Iterable
import difflib


class OdocalError(Exception):
    """Base of all errors raised here on purpose: the text says what, where and what to do."""


class BadConfig(OdocalError):
    """A setting is unknown, of the wrong type or out of range: edit the file or parameter."""


class BadData(OdocalError):
    """Samples break their contract (shape, type): correct the source."""


class BadBag(OdocalError):
    """A recording is missing, unreadable or holds nothing usable."""


class BadUsage(OdocalError):
    """An option or argument is invalid: correct the call."""


def unknown_name(name: str, names: Iterable[str]) -> str:
    """Return the text for a name that is none of ``names``: similar ones, and all of them."""
    known = list(names)
    similar = difflib.get_close_matches(name, known, 3)
    hint = f'did you mean {" or ".join(similar)}? ' if similar else ''
    return f'{hint}required: one of {", ".join(known)}'
