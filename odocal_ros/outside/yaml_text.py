# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""YAML of parameter files, value by value: read identically by rcl, by YAML 1.1 and by odocal."""

from collections.abc import Mapping
from datetime import datetime, UTC
import math
from typing import Any

from odocal_ros.outside.names import one_line


def value_text(value: object) -> str:
    """Return a value to its last bit; text in quotes, so that a joint may be named 0 or on."""
    if value is None or isinstance(value, float):
        return number(value)
    if isinstance(value, (tuple, list)):
        return f'[{", ".join(map(value_text, value))}]'
    if isinstance(value, str):
        import yaml
        text: str = yaml.safe_dump(one_line(value), default_style='"', allow_unicode=True,
                                   width=math.inf)
        return text.rstrip('\n')
    return str(value).lower()


def number(value: float | None) -> str:
    """Return a double as YAML that every reader types as one: 1e-05 is text to YAML 1.1."""
    if value is None or not math.isfinite(value):
        return '.nan'
    text = repr(float(value))
    mantissa, e, exponent = text.partition('e')
    return text if not e or '.' in mantissa else f'{mantissa}.0e{exponent}'


def no_date(iso: str) -> str:
    """
    Return a date and time, UTC, as text that YAML takes for text even without its quotes.

    ros2 param load reads each value twice, and a date it cannot set.
    """
    return f'{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC'


def parameters(values: Mapping[str, Any], key: str = '/**') -> str:
    """Return the block of a parameter file; dicts among the values are groups."""
    return f'{key}:\n  ros__parameters:\n{_lines(values, 4)}'


def _lines(values: Mapping[str, Any], indent: int) -> str:
    return ''.join(
        f'{" " * indent}{name}:\n{_lines(value, indent + 2)}' if isinstance(value, dict) else
        f'{" " * indent}{name}: {value_text(value)}\n' for name, value in values.items())
