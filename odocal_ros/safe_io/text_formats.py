# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Safe text in the formats of other programs: terminal, shell, launch file, XML, table, YAML.

Names in a bag (frame, topic, type, joint, file) are untrusted: code that writes a format passes
them through the function of this format. A frame is accepted only if ROS accepts it, since
programs act on files that contain it. YAML values have the same type for every reader; YAML is
read with limits.
"""

from collections.abc import Mapping, Sequence
from datetime import datetime, UTC
from functools import cache
import math
import re
import shlex
from typing import Any

from odocal_ros.errors import BadConfig
from odocal_ros.safe_io.limits import check

# escaped in every line: control characters, lone surrogates, changes of writing direction
INVISIBLE = re.compile('[\x00-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202f\u2060-\u206f'
                    '\ufeff\ufff9-\ufffb\ud800-\udfff]')
# the only escape sequences that may reach a terminal: colours of these words
VERDICT_STYLE = re.compile('(\x1b\\[1;3[123]m(?:ACCEPTED|CAUTION|REJECTED)\x1b\\[0m)')
LONGEST_LINE = 2000       # judgement: characters of one line of a log, a panel or an error
FRAME = re.compile(r'[A-Za-z0-9_][A-Za-z0-9_./-]{0,199}')
MAX_YAML_NODES = 30_000      # judgement: mappings, lists and values; reading takes seconds


def one_line(text: object) -> str:
    """Return text as one line, invisible characters as escape sequences."""
    return INVISIBLE.sub(lambda match: match[0].encode('unicode_escape').decode(), str(text))


def indented_list(names: Sequence[str]) -> str:
    """Return the lines of a list that follows a colon: one name on each, at most 100."""
    shown = [*map(one_line, names[:100]), *[f'{len(names) - 100} more'] * (len(names) > 100)]
    return '\n  ' + ',\n  '.join(shown)


def brief_line(text: object) -> str:
    """Return ``one_line`` of a text, cut at LONGEST_LINE, for a log, a panel or an error."""
    # cut first: an escape sequence is up to ten times as long as its character
    line = one_line(str(text)[:LONGEST_LINE + 1])
    return line if len(line) <= LONGEST_LINE else f'{line[:LONGEST_LINE]} ...'


def error_text(error: BaseException) -> str:
    """Return the text of an error as one line of limited length."""
    return brief_line(' '.join(str(error)[:10 * LONGEST_LINE].split()))


def for_terminal(text: str) -> str:
    """Return lines for a terminal that neither move its cursor nor set its state."""
    parts = VERDICT_STYLE.split(text)
    parts[::2] = ['\n'.join(map(one_line, part.split('\n'))) for part in parts[::2]]
    return ''.join(parts)


def is_frame(name: str) -> bool:
    """Return True if a frame name is valid in tf2 and safe in every file that contains it."""
    return FRAME.fullmatch(name) is not None


def for_comment(text: str) -> str:
    """Return lines as comment lines of YAML, a shell or a table."""
    return ''.join(f'# {one_line(line)}\n' for line in text.split('\n'))


def for_table(text: str) -> str:
    """Return text as a cell that no spreadsheet reads as a formula."""
    return f"'{text}" if text.startswith(('=', '+', '-', '@')) else text


def for_xml_comment(text: str) -> str:
    """Return lines for the inside of an XML comment, without ``--``."""
    return re.sub('-(?=-)', '- ', '\n'.join(map(one_line, text.split('\n'))))


def for_launch(words: list[str]) -> str:
    """Return the words of a command as an attribute of a launch file: nothing is substituted."""
    return re.sub(r'([\\$"\'])', r'\\\1', for_shell(words))


def for_shell(words: list[str]) -> str:
    """Return the words of a command quoted for a shell."""
    return shlex.join(map(one_line, words))


def yaml_value(value: object) -> str:
    """Return a value as YAML with all digits; text in quotes, since a joint may be named 0."""
    if value is None or isinstance(value, float):
        return yaml_number(value)
    if isinstance(value, (tuple, list)):
        return f'[{", ".join(map(yaml_value, value))}]'
    if isinstance(value, str):
        import yaml
        text: str = yaml.safe_dump(one_line(value), default_style='"', allow_unicode=True,
                                   width=math.inf)
        return text.rstrip('\n')
    return str(value).lower()


def yaml_number(value: float | None) -> str:
    """Return a double as YAML, nan for None, with a point: 1e-05 is text in YAML 1.1."""
    if value is None or not math.isfinite(value):
        return '.nan'
    text = repr(float(value))
    mantissa, separator, exponent = text.partition('e')
    return text if not separator or '.' in mantissa else f'{mantissa}.0e{exponent}'


def date_text(iso: str) -> str:
    """Return a date and time, UTC, as text for YAML: ros2 param load cannot set a date."""
    return f'{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC'


def parameter_block(values: Mapping[str, Any], key: str = '/**') -> str:
    """Return ROS parameters as YAML; a dict among the values is a group.   key : node names."""
    return f'{key}:\n  ros__parameters:\n{_lines(values, 4)}'


def _lines(values: Mapping[str, Any], indent: int) -> str:
    return ''.join(
        f'{" " * indent}{name}:\n{_lines(value, indent + 2)}' if isinstance(value, dict) else
        f'{" " * indent}{name}: {yaml_value(value)}\n' for name, value in values.items())


@cache
def safe_loader(aliases: bool = False) -> Any:
    """Return a safe loader that refuses deep nesting, and ``*links`` unless ``aliases``."""
    import yaml

    class LimitedLoader(yaml.SafeLoader):       # type: ignore[misc]  # PyYAML has no types here
        """Limits nesting and number of the nodes."""

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
            check(self.nodes, MAX_YAML_NODES, 'the YAML text', 'values')
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
    return LimitedLoader


def compose_yaml(text: str, where: str) -> Any:
    """Return the root node of a YAML text, None if empty; raise BadConfig with file and line."""
    import yaml
    try:
        return yaml.compose(text, Loader=safe_loader())
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, 'problem_mark', None)
        line = f', line {mark.line + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or ' '.join(str(error).split())
        raise BadConfig(f'{where}{line}: not valid YAML: {problem}') from None
