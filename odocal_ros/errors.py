# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors raised on purpose; commands and nodes catch OdocalError once and show its sentence."""

from collections.abc import Iterable
from difflib import SequenceMatcher


class OdocalError(Exception):
    """Base of all errors raised here on purpose: the text says what, where and what to do."""


class BadConfig(OdocalError):
    """A setting is unknown, of the wrong type or out of range: edit the file or parameter."""


class BadData(OdocalError):
    """Samples break their contract (shape, type): correct the source."""


class UndefinedType(BadData):
    """Messages have a type that neither ROS nor the bag defines."""


class BadBag(OdocalError):
    """A recording is missing, unreadable or holds nothing usable."""


class BadUsage(OdocalError):
    """An option or argument is invalid: correct the call."""


class BadTopics(BadUsage):
    """The topics of a bag do not fit; the text lists topics, escaped, one on each line."""


def similar_names(name: str, names: Iterable[str]) -> list[str]:
    """Return at most three of ``names`` that contain a wrong one, else the most similar ones."""
    known_names = list(names)
    if longer := [known for known in known_names if name and name in known]:
        return longer[:3]
    lowest, margin = 0.6, 0.1     # judgement: least similarity; and below that of the best
    ranked = sorted(((SequenceMatcher(None, name, known).ratio(), known) for known in known_names),
                    reverse=True)
    return [known for ratio, known in ranked[:3] if ratio >= max(lowest, ranked[0][0] - margin)]


def unknown_name(name: str, names: Iterable[str]) -> str:
    """Return the text for a name that is none of ``names``: similar ones, and all of them."""
    known = list(names)
    similar = similar_names(name, known)
    hint = f'did you mean {" or ".join(similar)}? ' if similar else ''
    return f'{hint}required: one of {", ".join(known)}'
