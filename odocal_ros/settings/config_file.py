# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Settings from ROS parameter files and from ``key=value``, read as the node reads them.

A file has the same meaning for ``odocal replay --config`` as for ``--params-file``: blocks are
matched and applied in file order as in rcl, and plain scalars have types by rcl's rules, which
differ from YAML 1.1 (``1e-3`` is a number, ``1_000`` is text).
"""

from collections.abc import Iterator
from pathlib import Path
import re
from typing import Any

from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.safe_io.limits import read_text
from odocal_ros.safe_io.text_formats import compose_yaml
from odocal_ros.settings.config import Config, SETTINGS
from odocal_ros.settings.setting import REMOVED_GROUPS, with_settings

NODE = '/calibrator'
PARAMETERS = 'ros__parameters'
VALID_KEYS = "'/**', '/**/calibrator', '/calibrator' or 'calibrator'"
# other parameters of a node, written by ros2 param dump and by ~/save
FOREIGN_PARAMETERS = re.compile(
    r'(result|qos_overrides)\.|(use_sim_time|start_type_description_service)$')
TRUE = {'y', 'Y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON'}
FALSE = {'n', 'N', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF'}
WHOLE_NUMBER = re.compile(r'[-+]?(?:(0[xX][0-9a-fA-F]+)|(0[0-7]*)|[1-9][0-9]*)')
MAX_LENGTH = 100        # judgement: characters of a number, or of a node's key
Node = Any           # of PyYAML
INF_OR_NAN = re.compile(r'([-+]?)\.(inf|Inf|INF|nan|NaN|NAN)')


def read_config_file(path: Path) -> dict[str, object]:
    """
    Return the settings of a ROS parameter file by dotted name, each checked.

    Raises BadUsage: the file cannot be read. Raises BadConfig: it is not a parameter file, has no
    block for the calibrator, an unknown setting or an invalid value; the text contains file and
    line.
    """
    return _settings(Path(path), _root(Path(path)))


def _root(path: Path) -> Node:
    try:
        return compose_yaml(read_text(path), str(path))
    except OSError as error:
        raise BadUsage(f'{path}: cannot be read ({error.strerror}); check --config') from None
    except UnicodeDecodeError:
        raise BadConfig(f'{path}: not a text file; required: a ROS parameter file '
                        '(YAML)') from None


def _settings(path: Path, root: Node, without_removed: bool = False) -> dict[str, object]:
    blocks = _blocks(root, '')
    matching = [block for key, block in blocks.items() if _matches_calibrator(key)]
    if not matching:
        found_keys = f'; it has {", ".join(blocks)}' if blocks else ''
        raise BadConfig(f'{path}: no block for the calibrator{found_keys}; required: a top-level '
                        f'key {VALID_KEYS} that contains {PARAMETERS}')
    values: dict[str, object] = {}
    for name, node in (pair for block in matching for mapping in block
                       for pair in _dotted_values(mapping, '')):
        if not (FOREIGN_PARAMETERS.match(name)
                or without_removed and name.partition('.')[0] in REMOVED_GROUPS):
            where = f'{path}, line {node.start_mark.line + 1}: '
            values[name] = _check_value(name, _value(node), where)
    return values


def read_journal_file(path: Path, block: str) -> tuple[dict[str, object], dict[str, str]]:
    """Return a journal's settings, of earlier versions too, and one other block as text."""
    root = _root(path)
    return _settings(path, root, without_removed=True), {
        name: node.value for mapping in _blocks(root, '').get(block, ())
        for name, node in _dotted_values(mapping, '') if isinstance(node.value, str)}


def parse_set(text: str) -> tuple[str, object]:
    """
    Return (name, value) of ``key=value``; the value is YAML, checked against its setting.

    Raises BadUsage: there is no ``=``, or the value is not YAML. Raises BadConfig: the setting is
    unknown or the value invalid.
    """
    name, equals, value = text.partition('=')
    name = name.strip()
    if not equals or not name:
        raise BadUsage(f'--set {text}: required: key=value, such as --set leg.min_distance=50')
    try:
        node = compose_yaml(value, f'--set {name}')
    except BadConfig as error:
        raise BadUsage(str(error)) from None
    if name in SETTINGS and SETTINGS[name].kind == 'str' and not _is_quoted(node):
        # a joint may be named 0 or on
        return name, _check_value(name, value.strip(), '--set ')
    where = '--set ' if name in SETTINGS else '--set: '           # followed by the setting's name
    return name, _check_value(name, '' if node is None else _value(node), where)


def _is_quoted(node: Node) -> bool:
    return node is not None and getattr(node, 'style', None) in ('"', "'")


def _pairs(node: Node) -> list[tuple[str, Node]]:
    """Return the (key text, value node) pairs of a mapping, none of anything else."""
    import yaml
    if not isinstance(node, yaml.MappingNode):
        return []
    return [(key.value, value) for key, value in node.value]


def _blocks(node: Node, prefix: str) -> dict[str, list[Node]]:
    """Return the parameter mappings by node key; a repeated key continues its block, as in rcl."""
    blocks: dict[str, list[Node]] = {}
    for key, value in _pairs(node):
        if key == PARAMETERS and prefix:
            blocks.setdefault(prefix, []).append(value)
        elif isinstance(key, str):
            name = f'{prefix}/{key}' if prefix else key
            for node_key, mappings in _blocks(value, name).items():
                blocks.setdefault(node_key, []).extend(mappings)
    return blocks


def _matches_calibrator(key: str) -> bool:
    """Return True if a node key, with the wildcards * and **, matches /calibrator."""
    if len(key) > MAX_LENGTH:
        return False
    wildcards = {'**': r'(?:/\w+)*', '*': r'/\w+'}
    pattern = ''.join(wildcards.get(part, '/' + re.escape(part))
                      for part in key.strip('/').split('/'))
    return re.fullmatch(pattern, NODE) is not None


def _dotted_values(node: Node, prefix: str) -> Iterator[tuple[str, Node]]:
    """Yield (dotted name, value node) of nested and dotted keys."""
    import yaml
    for key, value in _pairs(node):
        name = f'{prefix}{key}'
        if isinstance(value, yaml.MappingNode):
            yield from _dotted_values(value, f'{name}.')
        else:
            yield name, value


def _value(node: Node) -> Any:
    import yaml
    if isinstance(node, yaml.ScalarNode):
        return node.value if _is_quoted(node) or node.style in ('|', '>') else scalar(node.value)
    if isinstance(node, yaml.SequenceNode):
        return [_value(item) for item in node.value]
    return {key: _value(value) for key, value in _pairs(node)}


def scalar(text: str) -> bool | int | float | str:
    """Return a plain scalar with the type that rcl gives it (measured on rcl 9.2)."""
    if text in TRUE or text in FALSE:
        return text in TRUE
    if len(text) > MAX_LENGTH:
        return text
    if match := WHOLE_NUMBER.fullmatch(text):
        number = int(text, 16 if match[1] else 8 if match[2] else 10)
        if -2**63 <= number < 2**63:
            return number
    special = INF_OR_NAN.fullmatch(text)      # Python has no dot in them
    try:
        return float(special[1] + special[2] if special else text) if '_' not in text else text
    except ValueError:
        return text


def _check_value(name: str, value: object, where: str) -> Any:
    try:
        with_settings(Config(), {name: value})
    except BadConfig as error:
        hint = ''
        if name in SETTINGS and SETTINGS[name].kind == 'str' and not isinstance(value, str):
            hint = '; write it in quotes'
        raise BadConfig(f'{where}{error}{hint}') from None
    return SETTINGS[name].checked(value)
