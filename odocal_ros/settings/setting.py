# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Declaration of a setting in a dataclass, and the check of its values."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, Field, field, fields, is_dataclass, replace
from functools import cache
import math
from typing import Any, ClassVar, Protocol, TypeVar

from odocal_ros.errors import BadConfig, similar_names
from odocal_ros.safe_io.text_formats import is_frame, one_line

REMOVED_GROUPS = {'projection'}      # of settings of earlier versions
TYPES = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'text'}


class Settings(Protocol):
    """A dataclass of settings and groups of them."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


AnyConfig = TypeVar('AnyConfig', bound=Settings)


@dataclass(frozen=True)
class Setting:
    """One setting: source of a parameter descriptor, a YAML line and a table row."""

    name: str
    default: Any              # if NaN, the value may be NaN
    unit: str = ''
    low: float | None = None         # range of the value
    high: float | None = None
    about: str = ''                  # description, in docs/settings.md
    choices: Sequence[str] = ()
    read_only: bool = False          # read-only after start-up
    frame: bool = False       # the value is the name of a coordinate frame
    item: type = float        # type of the values of a list
    any_length: bool = False        # a list of any length

    @property
    def kind(self) -> str:
        """Return bool, int, float, str, floats or strs (lists)."""
        if not isinstance(self.default, tuple):
            return type(self.default).__name__
        return f'{self.item.__name__}s'

    def checked(self, value: Any) -> Any:
        """Return value as this setting's type, or raise BadConfig with the requirement."""
        if isinstance(self.default, tuple):
            if isinstance(value, str) or not hasattr(value, '__len__'):
                raise BadConfig(f'{self.name}: {value!r} is not a list; required: a list '
                                'such as [A, B, C]')
            if self.item is str:        # an index is a name too
                return tuple(self._check_item(str(item) if type(item) is int else item, str)
                             for item in value)
            items = tuple(self._check_item(item, float) for item in value)
            lengths = (3,) if self.default else (0, 4)
            if len(items) not in lengths and not self.any_length:
                raise BadConfig(f'{self.name}: {len(items)} values; required: {lengths[-1]}')
            return items
        return self._check_item(value, type(self.default))

    def _check_item(self, value: Any, kind: type[Any]) -> Any:
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not kind:
            raise BadConfig(f'{self.name}: {value!r} is not {TYPES[kind]}')
        if self.choices and value not in self.choices:
            raise BadConfig(f'{self.name}: {value!r} is not one of {", ".join(self.choices)}')
        if isinstance(value, str):
            self._check_text(value)
        if isinstance(value, (int, float)) and kind is not bool:
            is_nan = kind is float and math.isnan(value)
            if is_nan and not (isinstance(self.default, float) and math.isnan(self.default)):
                raise BadConfig(f'{self.name}: NaN is not allowed')
            if not is_nan and not math.isfinite(value):
                raise BadConfig(f'{self.name}: {value} is not finite')
            # larger than any value in SI units; sums with it stay finite
            largest = 1e9
            if kind is float and abs(value) > largest:
                raise BadConfig(f'{self.name} = {value:g}: the limit is {largest:g}')
            is_below = self.low is not None and value < self.low
            if is_below or self.high is not None and value > self.high:
                unit = '' if self.unit == '1' else self.unit
                raise BadConfig(f'{self.name} = {value:g}: required: {self.low:g} to '
                                f'{self.high:g} {unit}'.rstrip())
        return value

    def _check_text(self, value: str) -> None:
        """Refuse text with invisible characters, and names of frames that ROS does not allow."""
        if one_line(value) != value:
            raise BadConfig(f"{self.name}: '{one_line(value)}' has invisible characters")
        # empty is allowed if it is the default
        if self.frame and not is_frame(value) and value != self.default:
            raise BadConfig(f'{self.name}: {value!r} is not a frame name; allowed: letters, '
                            'digits and _ . / -, without a leading /')


def setting(default: object, *values: Any, **named_values: Any) -> Any:
    """Declare a setting by its default and the further fields of ``Setting``, in their order."""
    declared = Setting('', default, *values, **named_values)      # ``_settings`` adds the name
    return field(default=default, metadata={'setting': declared})


def _settings(owner: Settings, prefix: str = '') -> Iterator[Setting]:
    for declared in fields(owner):
        if is_dataclass(declared.default) and not isinstance(declared.default, type):
            yield from _settings(declared.default, f'{prefix}{declared.name}.')
        else:
            yield replace(declared.metadata['setting'], name=prefix + declared.name)


@cache
def settings_of(kind: type) -> dict[str, Setting]:
    """Return the settings of a dataclass by dotted name."""
    return {declared.name: declared for declared in _settings(kind())}


def with_settings(config: AnyConfig, changes: Mapping[str, Any]) -> AnyConfig:
    """
    Return config with settings changed by dotted name, each checked.

    Raises BadConfig: unknown name (the text names similar ones), wrong type, out of range.
    """
    groups: dict[str, dict[str, Any]] = {}
    settings = settings_of(type(config))
    for name, value in changes.items():
        if name not in settings:
            similar, group = similar_names(name, settings), name.partition('.')[0]
            hint = (f'did you mean {" or ".join(similar)}?' if similar else
                    f'the settings {group}.* were removed; delete them'
                    if group in REMOVED_GROUPS else 'docs/settings.md lists all')
            raise BadConfig(f'no setting {name!r}; {hint}')
        group, _, leaf = name.rpartition('.')
        groups.setdefault(group, {})[leaf] = settings[name].checked(value)
    top = groups.pop('', {})
    nested = {group: replace(getattr(config, group), **values)
              for group, values in groups.items()}
    return replace(config, **top, **nested)
