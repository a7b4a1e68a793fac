# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a launch file would start, found without the packages launch and launch_ros."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
import re
import sys
from types import ModuleType
from unittest.mock import patch
from xml.etree import ElementTree

from bench import given as as_arguments, ROOT
import yaml


@dataclass
class Started:
    """One node as it would be started."""

    package: str
    executable: str
    name: str | None
    namespace: str
    remappings: dict[str, str]
    parameters: list                # paths and dicts, later ones win
    arguments: list[str]

    def command_line(self) -> list[str]:
        """Return the ROS arguments that launch_ros makes of it."""
        words = [] if not self.namespace else ['-r', f'__ns:=/{self.namespace}']
        for one in self.parameters:
            words += ['--params-file', one] if isinstance(one, str) else as_arguments(one)
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
    words = partial(text_of, arguments=arguments)
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
    return declared, list(_walk(root, partial(_filled, arguments=arguments), {}))


def _walk(element, filled, remaps):
    remaps = dict(remaps)          # those of a group end with it
    for child in element:
        if not _truth(filled(child.get('if', 'true'))) or _truth(
                filled(child.get('unless', 'false'))):
            continue
        if child.tag == 'group':
            yield from _walk(child, filled, remaps)
        elif child.tag == 'set_remap':
            remaps[child.get('from')] = filled(child.get('to'))
        elif child.tag == 'node':
            files = [filled(p.get('from')) for p in child.findall('param') if p.get('from')]
            values = {p.get('name'): yaml.safe_load(filled(p.get('value')))
                      for p in child.findall('param') if p.get('name')}
            yield Started(child.get('pkg'), child.get('exec'), child.get('name'),
                          filled(child.get('namespace')), dict(remaps), [*files, values],
                          filled(child.get('args', '')).split())
        elif child.tag != 'arg':
            raise ValueError(f'the stand-in knows no <{child.tag}>')


def _filled(text: str, arguments) -> str:
    text = text.replace('$(find-pkg-share odocal_ros)', str(ROOT))
    text = re.sub(r'\$\(var (\w+)\)', lambda m: arguments[m.group(1)], text)
    return re.sub(r'\$\(eval "([^"]*)"\)', lambda m: str(eval(m.group(1))), text)
