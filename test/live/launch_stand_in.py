# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a launch file would start, found without the packages launch and launch_ros."""

from dataclasses import dataclass, field
from pathlib import Path
import re
import sys
from types import ModuleType
from unittest.mock import patch
from xml.etree import ElementTree

import yaml

ROOT = Path(__file__).resolve().parents[2]     # config/ and launch/ lie alike in share/odocal_ros


@dataclass
class Started:
    """One node as it would be started."""

    package: str
    executable: str
    name: str | None
    namespace: str
    remappings: dict[str, str]
    parameters: list                # paths and dicts, later ones win
    arguments: list[str] = field(default_factory=list)

    def command_line(self) -> list[str]:
        """Return the ROS arguments that launch_ros makes of it."""
        words = [] if not self.namespace else ['-r', f'__ns:=/{self.namespace}']
        for given in self.parameters:
            words += ['--params-file', given] if isinstance(given, str) else [
                w for name, value in given.items() for w in (
                    '-p', f'{name}:={str(value).lower() if isinstance(value, bool) else value}')]
        return words + [w for pair in self.remappings.items() for w in ('-r', ':='.join(pair))]


class Late:
    """A substitution: text only once the arguments are known."""

    def __init__(self, text) -> None:
        self.text = text            # function of the arguments


def text_of(value, arguments):
    """Return what a value is for some arguments, lists joined as launch does."""
    if isinstance(value, Late):
        return value.text(arguments)
    if isinstance(value, list | tuple):
        return ''.join(str(text_of(v, arguments)) for v in value)
    return value


def _truth(text) -> bool:
    word = str(text).strip().lower()
    if word not in ('true', '1', 'false', '0'):
        raise ValueError(f'launch takes no {text!r} for a condition')
    return word in ('true', '1')


def of_python(path: Path, given: dict[str, str]) -> tuple[dict, list[Started]]:
    """Return declared arguments (default, description) and the nodes of a Python launch file."""
    declared = {}

    def declare(name, default_value, description):
        declared[name] = (text_of(default_value, {}), description)

    def package_share(package):
        return Late(lambda _: str(ROOT) if package == 'odocal_ros' else f'/share/{package}')

    stand_ins = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {'DeclareLaunchArgument': declare},
        'launch.conditions': {'IfCondition': lambda v: (v, True),
                              'UnlessCondition': lambda v: (v, False)},
        'launch.substitutions': {
            'LaunchConfiguration': lambda name: Late(lambda a: a[name]),
            'PathJoinSubstitution': lambda parts: Late(
                lambda a: '/'.join(text_of(p, a) for p in parts)),
            'PythonExpression': lambda parts: Late(lambda a: str(eval(text_of(parts, a))))},
        'launch_ros': {}, 'launch_ros.actions': {'Node': dict},
        'launch_ros.parameter_descriptions': {'ParameterValue': lambda value, value_type: Late(
            lambda a: _truth(text_of(value, a)) if value_type is bool
            else value_type(text_of(value, a)))},
        'launch_ros.substitutions': {'FindPackageShare': package_share}}
    modules = {name: ModuleType(name) for name in stand_ins}
    for name, content in stand_ins.items():
        modules[name].__dict__.update(content)
    with patch.dict(sys.modules, modules):
        scope: dict = {}
        exec(compile(path.read_text(encoding='utf-8'), str(path), 'exec'), scope)
        nodes = [e for e in scope['generate_launch_description']() if e is not None]
    arguments = {name: default for name, (default, _) in declared.items()} | given
    return declared, [_started(node, arguments) for node in nodes if _wanted(node, arguments)]


def _wanted(node, arguments) -> bool:
    value, sense = node.get('condition', ('true', True))
    return _truth(text_of(value, arguments)) is sense


def _started(node, arguments) -> Started:
    def words(value):
        return text_of(value, arguments)
    return Started(
        node['package'], node['executable'], node.get('name'), words(node['namespace']),
        {a: words(b) for a, b in node.get('remappings', ())},
        [{k: words(v) for k, v in p.items()} if isinstance(p, dict) else words(p)
         for p in node['parameters']], [words(a) for a in node.get('arguments', ())])


def of_xml(path: Path, given: dict[str, str]) -> tuple[dict, list[Started]]:
    """Return declared arguments (default, description) and the nodes of an XML launch file."""
    root = ElementTree.parse(path).getroot()
    declared = {a.get('name'): (_filled(a.get('default', ''), {}), a.get('description'))
                for a in root.findall('arg')}
    arguments = {name: default for name, (default, _) in declared.items()} | given
    nodes: list[Started] = []
    _walk(root, arguments, {}, nodes)
    return declared, nodes


def _walk(element, arguments, remaps, nodes) -> None:
    remaps = dict(remaps)          # those of a group end with it
    for child in element:
        if not _truth(_filled(child.get('if', 'true'), arguments)) or _truth(
                _filled(child.get('unless', 'false'), arguments)):
            continue
        if child.tag == 'group':
            _walk(child, arguments, remaps, nodes)
        elif child.tag == 'set_remap':
            remaps[child.get('from')] = _filled(child.get('to'), arguments)
        elif child.tag == 'node':
            nodes.append(_of_element(child, arguments, remaps))
        elif child.tag != 'arg':
            raise ValueError(f'the stand-in knows no <{child.tag}>')


def _of_element(node, arguments, remaps) -> Started:
    files = [_filled(p.get('from'), arguments) for p in node.findall('param') if p.get('from')]
    values = {p.get('name'): yaml.safe_load(_filled(p.get('value'), arguments))
              for p in node.findall('param') if p.get('name')}
    return Started(node.get('pkg'), node.get('exec'), node.get('name'),
                   _filled(node.get('namespace'), arguments), dict(remaps), [*files, values],
                   _filled(node.get('args', ''), arguments).split())


def _filled(text: str, arguments) -> str:
    text = re.sub(r'\$\(find-pkg-share odocal_ros\)', str(ROOT), text)
    text = re.sub(r'\$\(var (\w+)\)', lambda m: arguments[m.group(1)], text)
    return re.sub(r'\$\(eval "([^"]*)"\)', lambda m: str(eval(m.group(1))), text)
