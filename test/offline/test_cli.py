# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The odocal command: exit codes, one-line errors, progress, doctor, ros2 odocal."""

import argparse
from importlib import import_module
from importlib.metadata import version
import inspect
import os
from pathlib import Path
import pty
import re
import shutil
import subprocess
import sys

import pytest

from odocal_ros import __version__
from odocal_ros.errors import BadBag
from odocal_ros.offline import cli, doctor

pytestmark = pytest.mark.core
# commands of this package; it knows only the names of others
OWN = [name for name, (home, _) in cli.COMMANDS.items() if home.startswith('odocal_ros.')]
SETUP = Path(__file__).resolve().parents[2] / 'setup.py'
CODE = """
from odocal_ros.offline.cli import show_phase
with show_phase('reading town', quiet={quiet}) as phase:
    phase(0.25)
    phase(0.5, 'leg 2 of 2')
    phase(None, 'smoother, 7 passes done')
with show_phase('drawing the report'):
    pass
print('the result')
"""


def test_every_command_has_help_and_a_missing_command_fails(capsys):
    for argv in (['--help'], *([c, '--help'] for c in OWN)):
        with pytest.raises(SystemExit) as end:
            cli.main(argv)
        assert end.value.code == 0
        assert 'usage: odocal' in capsys.readouterr().out
    assert cli.main([]) == 2
    assert 'replay' in capsys.readouterr().out


def test_a_full_disk_gives_one_line_and_exit_code_2():
    with open('/dev/full', 'w') as full:
        done = subprocess.run([sys.executable, '-m', 'odocal_ros.offline.cli', 'doctor'],
                              stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1
    assert 'No space left' in done.stderr


@pytest.mark.parametrize('argv', [
    ['fly'], ['replay'], ['replay', 'x', '--nonsense'], ['replay', 'x', '--method', 'magic']])
def test_wrong_use_gives_one_line_and_exit_code_2(argv, capsys):
    assert cli.main(argv) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert '--help' in err
    assert cli.main(['replya', 'x']) == 2
    assert "no command 'replya'; did you mean replay? required: one of try, replay," in \
        capsys.readouterr().err


@pytest.mark.parametrize(('error', 'code'), [
    (BadBag('x.db3: empty'), 2), (KeyboardInterrupt(), 130), (ZeroDivisionError('oops'), 3)])
def test_errors_give_one_line_and_their_exit_code(error, code, monkeypatch, capsys):
    def run(args):
        raise error
    monkeypatch.setattr(import_module(cli.COMMANDS['replay'][0]), 'run', run)
    assert cli.main(['replay', 'x']) == code
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert 'Traceback' not in err
    if code == 3:       # an internal error leaves a trace file
        assert 'ZeroDivisionError: oops' in Path(err.split()[-1]).read_text()


def test_the_package_runs_as_a_module():
    result = subprocess.run([sys.executable, '-m', 'odocal_ros', '--version'], text=True,
                            capture_output=True, check=True)
    assert result.stdout == f'odocal_ros {__version__}\n'


@pytest.mark.parametrize('argv', [['paper'], ['patent', '--json'], ['paper', '--help']])
def test_a_command_of_a_package_that_is_not_installed_names_what_to_install(
        argv, monkeypatch, capsys):
    assert set(cli.COMMANDS) - set(OWN) == {'paper', 'patent'}
    monkeypatch.setattr('importlib.metadata.entry_points', lambda **calls: [])
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err == (f'odocal: {argv[0]} is a command of odocal_reproductions, which is not '
                   'installed; install it from a checkout of odocal_ros: '
                   'pip install ./reproductions\n')


def shown(capsys):
    code = cli.main(['doctor'])
    rows = dict(line.split('  ', 1) for line in capsys.readouterr().out.splitlines()[:-1])
    return code, {name: text.strip() for name, text in rows.items()}


def test_doctor_shows_installed_and_missing_packages(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    monkeypatch.setenv('SOME_TOKEN', 'a secret')
    code, rows = shown(capsys)
    assert code == 0
    assert rows['odocal_ros'].startswith(f'{__version__}, ')
    assert rows['Python'].endswith(sys.executable)
    assert rows['numpy'] == version('numpy')
    assert rows['results of a node'].startswith(f'{tmp_path}/odocal, can be written')
    assert float(rows['results of a node'].split()[-3]) <= shutil.disk_usage(tmp_path).total / 1e9
    assert 'a secret' not in str(rows)
    try:
        from rclpy.utilities import get_rmw_implementation_identifier
    except ImportError:
        assert rows['rclpy'].startswith('none')
    else:
        assert rows['rmw'] == get_rmw_implementation_identifier()
    monkeypatch.setattr(doctor, 'NEEDED', ('numpy', 'no-such-thing'))
    assert cli.main(['doctor']) == 1
    assert 'missing: no-such-thing' in capsys.readouterr().out


def ros2(*argv):
    """Do as main and add_subparsers_on_demand of ros2cli (Jazzy) do; return the exit code."""
    group, = re.findall(r"'ros2cli.command': \['(.+)'\]", SETUP.read_text())
    name, module, attribute = re.fullmatch(r'(\w+) = ([\w.]+):(\w+)', group).groups()
    extension = getattr(import_module(module), attribute)()
    extension.NAME = name
    assert inspect.getdoc(extension)        # its first line is the help
    parser = argparse.ArgumentParser(prog='ros2')
    commands = parser.add_subparsers()
    command = commands.add_parser(name, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.exit, leave = lambda status=0, message=None: None, command.exit
    command.print_help, show = lambda: None, command.print_help
    parser.parse_known_args(argv)
    command.exit, command.print_help = leave, show
    extension.add_arguments(command, f'ros2 {name}')
    return extension.main(parser=parser, args=parser.parse_args(argv))


def test_all_arguments_reach_the_command(monkeypatch):
    calls = []
    monkeypatch.setattr(cli, 'main', lambda argv: calls.append(argv) or 5)
    words = ['replay', 'a bag', '--imu-topic', '/imu', '--set', 'a=b', '--help']
    assert ros2('odocal', *words) == 5
    assert calls == [words]


def test_help_lists_the_commands_and_errors_are_those_of_odocal(capsys):
    with pytest.raises(SystemExit) as stopped:
        ros2('odocal', '--help')
    assert stopped.value.code == 0
    out = capsys.readouterr().out
    assert all(re.search(rf'^  {name} +\w', out, re.MULTILINE) for name in cli.COMMANDS)
    assert ros2('odocal') == 2          # shows its help
    assert 'usage: odocal' in capsys.readouterr().out
    assert ros2('odocal', 'replay') == 2
    assert capsys.readouterr().err.startswith('odocal replay: ')


def run(quiet=False):
    """Return the text on stdout, and on stderr, which is a terminal."""
    master, slave = pty.openpty()
    child = subprocess.Popen([sys.executable, '-c', CODE.format(quiet=quiet)], text=True,
                             stdout=subprocess.PIPE, stderr=slave)
    os.close(slave)
    shown = b''
    try:
        while chunk := os.read(master, 65536):
            shown += chunk
    except OSError:      # the other side is closed
        pass
    os.close(master)
    out, _ = child.communicate(timeout=60)
    assert child.returncode == 0, shown
    return out, shown.decode()


def test_a_terminal_shows_each_phase_and_erases_it_and_a_pipe_shows_none():
    out, shown = run()
    assert out == 'the result\n'
    for part in ('reading town', '25 %', 'leg 2 of 2', '50 %', 'drawing the report'):
        assert part in shown, part
    *_, last = (line for line in shown.split('\r') if 'smoother' in line)
    assert '%' not in last
    assert shown.split('\r')[-1].strip() == ''      # the line is erased
    assert '\n' not in shown.replace('\r\n', '')
    assert run(quiet=True)[1].count('reading') == 0
    # nothing is written if stderr is a file or a pipe
    done = subprocess.run([sys.executable, '-c', CODE.format(quiet=False)], text=True,
                          capture_output=True, timeout=60)
    assert (done.stdout, done.stderr) == ('the result\n', '')
