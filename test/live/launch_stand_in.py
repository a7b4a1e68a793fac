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


def _truth(text) -> bool:
    word = str(text).strip().lower()
    if word not in ('true', '1', 'false', '0'):
        raise ValueError(f'launch takes no {text!r} for a condition')
    return word in ('true', '1')


def of_python(path: Path, given: dict[str, str]) -> tuple[dict, list[Started]]:
    """Return declared arguments and the nodes of a Python launch file that includes one of XML."""
    stand_ins = {
        'launch': {'LaunchDescription': list},
        'launch.actions': {'IncludeLaunchDescription': lambda source: source},
        'launch.launch_description_sources': {'AnyLaunchDescriptionSource': Path}}
    modules = {name: ModuleType(name) for name in stand_ins}
    for name, content in stand_ins.items():
        modules[name].__dict__.update(content)
    with patch.dict(sys.modules, modules):
        scope: dict = {'__file__': str(path)}
        exec(compile(path.read_text(encoding='utf-8'), str(path), 'exec'), scope)
        included, = scope['generate_launch_description']()
    return of_xml(included, given)


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
