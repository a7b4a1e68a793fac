# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""YAML: values of the same type for every reader; untrusted trees, with limits."""

from collections.abc import Mapping
from datetime import datetime, UTC
from functools import cache
import math
from typing import Any

from odocal_ros.errors import BadConfig
from odocal_ros.outside.limits import check
from odocal_ros.outside.names import one_line

NODES = 30_000      # judgement: mappings, lists and values of a text: some seconds


def value_text(value: object) -> str:
    """Return a value as YAML in full; text in quotes, so that a joint may be named 0 or on."""
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
    """Return a double as YAML that is a double for every reader: 1e-05 is text in YAML 1.1."""
    if value is None or not math.isfinite(value):
        return '.nan'
    text = repr(float(value))
    mantissa, e, exponent = text.partition('e')
    return text if not e or '.' in mantissa else f'{mantissa}.0e{exponent}'


def no_date(iso: str) -> str:
    """
    Return a date and time, UTC, as text that YAML reads as text even without quotes.

    ros2 param load reads each value twice, and cannot set a date.
    """
    return f'{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC'


def parameters(values: Mapping[str, Any], key: str = '/**') -> str:
    """Return the block of a parameter file; dicts among the values are groups."""
    return f'{key}:\n  ros__parameters:\n{_lines(values, 4)}'


def _lines(values: Mapping[str, Any], indent: int) -> str:
    return ''.join(
        f'{" " * indent}{name}:\n{_lines(value, indent + 2)}' if isinstance(value, dict) else
        f'{" " * indent}{name}: {value_text(value)}\n' for name, value in values.items())


@cache
def loader(aliases: bool = False) -> Any:
    """Return a safe loader that refuses deep nesting, and ``*links`` unless ``aliases``."""
    import yaml

    class Plain(yaml.SafeLoader):       # type: ignore[misc]  # PyYAML has no types here
        """Composes nodes within limits."""

        depth = nodes = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            mark = self.peek_event().start_mark
            if not aliases and self.check_event(yaml.AliasEvent):
                raise yaml.composer.ComposerError(
                    None, None, 'aliases (*name) are not supported, as in ROS', mark)
            deepest = 30    # of mappings and lists in each other
            if self.depth >= deepest:
                raise yaml.composer.ComposerError(
                    None, None, f'nested deeper than {deepest} levels', mark)
            self.nodes += 1
            check(self.nodes, NODES, 'the YAML text', 'values')
            self.depth += 1
            try:
                node = super().compose_node(parent, index)
            finally:
                self.depth -= 1
            if isinstance(node, yaml.MappingNode) and not all(
                    isinstance(key, yaml.ScalarNode) for key, _ in node.value):
                raise yaml.composer.ComposerError(None, None, 'a key that is not text', mark)
            return node

        def flatten_mapping(self, node: Any) -> None:
            """Ignore merges (<<): a few nested ones make millions of keys."""
    return Plain


def composed(text: str, where: str) -> Any:
    """Return the root node of a text (None: it is empty), or raise BadConfig with the place."""
    import yaml
    try:
        return yaml.compose(text, Loader=loader())
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, 'problem_mark', None)
        line = f', line {mark.line + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or ' '.join(str(error).split())
        raise BadConfig(f'{where}{line}: not valid YAML: {problem}') from None
