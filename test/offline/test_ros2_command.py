# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ros2 odocal: the words after it reach odocal, by what ros2cli does with an extension."""

import argparse
from importlib import import_module
import inspect
from pathlib import Path
import re

import pytest

from odocal_ros.offline import cli

pytestmark = pytest.mark.core
SETUP = Path(__file__).resolve().parents[2] / 'setup.py'


def ros2(*argv):
    """Do as main and add_subparsers_on_demand of ros2cli (Jazzy) do; return the exit code."""
    group, = re.findall(r"'ros2cli.command': \['(.+)'\]", SETUP.read_text())
    name, module, attribute = re.fullmatch(r'(\w+) = ([\w.]+):(\w+)', group).groups()
    extension = getattr(import_module(module), attribute)()
    extension.NAME = name
    assert inspect.getdoc(extension)        # of which the first line is the help
    parser = argparse.ArgumentParser(prog='ros2')
    commands = parser.add_subparsers()
    own = commands.add_parser(name, formatter_class=argparse.RawDescriptionHelpFormatter)
    own.exit, leave = lambda status=0, message=None: None, own.exit
    own.print_help, show = lambda: None, own.print_help
    parser.parse_known_args(argv)
    own.exit, own.print_help = leave, show
    extension.add_arguments(own, f'ros2 {name}')
    return extension.main(parser=parser, args=parser.parse_args(argv))


def test_all_words_reach_the_command(monkeypatch):
    asked = []
    monkeypatch.setattr(cli, 'main', lambda argv: asked.append(argv) or 5)
    words = ['replay', 'a bag', '--imu-topic', '/imu', '--set', 'a=b', '--help']
    assert ros2('odocal', *words) == 5
    assert asked == [words]


def test_help_lists_the_commands_and_errors_are_those_of_odocal(capsys):
    with pytest.raises(SystemExit) as stopped:
        ros2('odocal', '--help')
    assert stopped.value.code == 0
    out = capsys.readouterr().out
    assert all(re.search(rf'^  {name} +\w', out, re.MULTILINE) for name in cli.COMMANDS)
    assert ros2('odocal') == 2          # its help
    assert 'usage: odocal' in capsys.readouterr().out
    assert ros2('odocal', 'replay') == 2
    assert capsys.readouterr().err.startswith('odocal replay: ')

