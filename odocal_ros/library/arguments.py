# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Arguments of a caller (settings, legs), and its receivers of notes and progress."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from datetime import datetime, timedelta, UTC
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NamedTuple

from odocal_ros.data.inputs import TOPICS
from odocal_ros.errors import BadUsage
from odocal_ros.safe_io.limits import LATEST_NS
from odocal_ros.safe_io.text_formats import brief_line, error_text
from odocal_ros.settings.config import Config, with_settings

# called with the fraction done, 0 to 1 or None if unknown, and the current stage
Progress = Callable[..., None]
Settings = Config | Mapping[str, object] | str | Path | None
Leg = str | tuple[float | None, float | None]
# judgement: s; larger times count from 1970, smaller ones from the bag's first message
MIN_UNIX_TIME = Decimal('1e8')
EACH_STOP = 'each-stop'
LEG_FORMS = ("required: 'A:B' or (A, B) in seconds, 'A/B' for ISO 8601 dates, or "
             f"'{EACH_STOP}'")


class Listener:
    """Receive notes and phases of the work; this one ignores them."""

    def note(self, text: str) -> None:
        """Receive a note for the user."""

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        """Return the context of a phase, which gives the function that receives its progress."""
        return nullcontext(lambda share, stage='': None)


class Notes(Listener):
    """Store the notes, and forward everything."""

    def __init__(self, listener: Listener) -> None:
        self.texts: list[str] = []
        self._listener = listener

    def note(self, text: str) -> None:
        """Store and forward a note."""
        self.texts.append(text)
        self._listener.note(text)

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        """Forward the phase."""
        return self._listener.phase(title)


class LegSpan(NamedTuple):
    """A requested leg; None: from the start, or to the end, of the recording."""

    start_ns: int | None
    stop_ns: int | None
    start_is_relative: bool = False    # counts from the bag's first message, else from 1970
    stop_is_relative: bool = False


def paths_of(argument: Any) -> list[Path]:
    """Return the paths of one bag or several; BadUsage: there is none, or one is not a path."""
    is_single = isinstance(argument, (str, Path)) or not isinstance(argument, Iterable)
    paths = [argument] if is_single else list(argument)
    if not paths:
        raise BadUsage('no bag is given; required: one path or several')
    for path in paths:
        try:
            with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
                Path(path).stat()       # the reader reports a missing file
        except (OSError, TypeError, ValueError) as error:
            raise BadUsage(f'{brief_line(repr(path)[:100])} is not the path of a bag: '
                           f'{error_text(error)[:100]}') from None
    return [Path(path) for path in paths]


def topics_of(argument: Any) -> dict[str, str]:
    """Return slot -> topic, or raise BadUsage if the argument is no mapping of slots."""
    if argument is not None and not isinstance(argument, Mapping):
        raise BadUsage("topics: required: a mapping of slot to topic such as {'imu': "
                       f"'/imu/data'}}, not {type(argument).__name__}")
    unknown = [slot for slot in argument or () if slot not in TOPICS]
    if unknown:
        raise BadUsage(f'topics: {brief_line(repr(unknown[0])[:100])} is not a slot; required: '
                       f'one of {", ".join(TOPICS)}')
    return dict(argument or {})


def config_of(argument: Settings, journal: Mapping[str, object] | None = None) -> Config:
    """
    Return all settings: defaults, then those of a journal, then those of ``argument``.

    argument : by dotted name, or a ROS parameter file; a Config is returned unchanged.

    Raises BadConfig, BadUsage: a setting is unknown or of a wrong value; the file cannot be read.
    """
    if isinstance(argument, Config):
        return argument
    if argument is not None and not isinstance(argument, (str, Path, Mapping)):
        raise BadUsage('config: required: a Config, a mapping of dotted names, or a parameter '
                       f'file, not {type(argument).__name__}')
    if '\0' in str(argument):
        raise BadUsage('config: the path contains a zero byte')
    if isinstance(argument, (str, Path)):
        from odocal_ros.settings.config_file import read_config_file
        argument = read_config_file(Path(argument))
    return with_settings(with_settings(Config(), journal or {}), argument or {})


def legs_of(argument: Iterable[Leg] | Leg | None) -> list[LegSpan | str]:
    """
    Return the requested legs, each a LegSpan or EACH_STOP.

    argument : 'A:B' in seconds from the bag's first message, 'A/B' for ISO 8601 dates,
        'each-stop', or (A, B), where None is the start or end of the recording; one or many.

    Raises BadUsage: one is not of these forms.
    """
    if argument is None:
        return []
    if not isinstance(argument, Iterable):
        raise BadUsage(f'legs: {argument!r}: {LEG_FORMS}')
    is_single = isinstance(argument, str) or _is_pair(argument)
    legs: Iterable[Any] = [argument] if is_single else argument
    return [leg if leg == EACH_STOP else parse_leg(_leg_text(leg)) for leg in legs]


def _is_pair(argument: Any) -> bool:
    """Return True for (A, B) with seconds or None, False for a tuple of legs and other types."""
    return isinstance(argument, tuple) and len(argument) == 2 and not any(
        isinstance(edge, (str, tuple)) for edge in argument)


def _leg_text(leg: Any) -> str:
    """Return a leg as text for ``parse_leg``."""
    if isinstance(leg, str):
        return leg
    if not _is_pair(leg):
        raise BadUsage(f'legs: {leg!r}: {LEG_FORMS}')
    return ':'.join('' if edge is None else f'{float(edge):.9f}' for edge in leg)


def parse_leg(text: str) -> LegSpan:
    """Return the leg of ``A:B``, s, or ``A/B``, ISO 8601, sides optional; raises BadUsage."""
    parts = text.split('/' if '/' in text else ':')
    if len(parts) != 2:
        raise BadUsage(f'--leg {text}: required: A:B in seconds, or A/B for ISO 8601 dates')
    (start, start_relative), (stop, stop_relative) = (_time_ns(p.strip(), text) for p in parts)
    if (start is not None and stop is not None and start_relative == stop_relative
            and stop <= start):
        raise BadUsage(f'--leg {text}: the end is not after the start; give the start first')
    return LegSpan(start, stop, start_relative, stop_relative)


def _time_ns(text: str, leg: str) -> tuple[int | None, bool]:
    """Return a time, ns, and whether it counts from the bag's first message; leg: for errors."""
    if not text:
        return None, False
    try:
        seconds = Decimal(text)
        if seconds.is_finite():
            if seconds.copy_abs() >= LATEST_NS // 10**9:
                raise BadUsage(f'--leg {leg}: {text[:40]} is out of range; the limit is the '
                               'year 2116')
            return int((seconds * 10**9).to_integral_value()), abs(seconds) < MIN_UNIX_TIME
    except InvalidOperation:
        pass
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        raise BadUsage(f'--leg {leg}: {text!r} is neither seconds nor an ISO 8601 date; use A:B '
                       'for seconds, A/B for dates') from None
    date = date if date.tzinfo else date.replace(tzinfo=UTC)
    # in whole numbers: a float has no ns since 1970
    time_ns = (date - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000
    if abs(time_ns) >= LATEST_NS:
        raise BadUsage(f'--leg {leg}: {text} is out of range; the limit is the year 2116')
    return time_ns, False
