# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The odocal command as a person meets it: exit codes, one line, no traceback."""

import importlib
import subprocess
import sys

import pytest

from odocal_ros import __version__
from odocal_ros.errors import BadBag
from odocal_ros.offline import cli

pytestmark = pytest.mark.core
# what this package has itself, of others it knows the names
OWN = [name for name, (home, _) in cli.COMMANDS.items() if home.startswith('odocal_ros.')]


def test_help_of_everything_is_there(capsys):
    for argv in (['--help'], *([c, '--help'] for c in OWN)):
        with pytest.raises(SystemExit) as end:
            cli.main(argv)
        assert end.value.code == 0
        assert 'usage: odocal' in capsys.readouterr().out


def test_no_command_shows_help_and_fails(capsys):
    assert cli.main([]) == 2
    assert 'replay' in capsys.readouterr().out


def test_a_full_disk_is_a_sentence_and_exit_2():
    with open('/dev/full', 'w') as full:
        done = subprocess.run([sys.executable, '-m', 'odocal_ros.offline.cli', 'doctor'],
                              stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.count('\n') == 1
    assert 'No space left' in done.stderr


@pytest.mark.parametrize('argv', [
    ['fly'], ['replay'], ['replay', 'x', '--nonsense'], ['replay', 'x', '--method', 'magic']])
def test_wrong_use_is_one_line_and_exit_2(argv, capsys):
    assert cli.main(argv) == 2
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert '--help' in err


def fake_command(monkeypatch, error):
    """Make every command end in an error."""
    def run(args):
        raise error
    for name in OWN:
        monkeypatch.setattr(importlib.import_module(cli.COMMANDS[name][0]), 'run', run)


@pytest.mark.parametrize(('error', 'code'), [
    (BadBag('x.db3: empty'), 2), (KeyboardInterrupt(), 130), (ZeroDivisionError('oops'), 3)])
def test_errors_are_one_line_with_their_exit_code(error, code, monkeypatch, capsys):
    fake_command(monkeypatch, error)
    assert cli.main(['replay', 'x']) == code
    err = capsys.readouterr().err
    assert err.count('\n') == 1
    assert 'Traceback' not in err


def test_an_internal_error_leaves_a_trace_file(monkeypatch, capsys):
    fake_command(monkeypatch, ZeroDivisionError('oops'))
    cli.main(['replay', 'x'])
    path = capsys.readouterr().err.split()[-1]
    with open(path) as f:
        assert 'ZeroDivisionError: oops' in f.read()


def test_help_imports_nothing_heavy():
    probe = ('import sys; from odocal_ros.offline.cli import main\n'
             'try: main(["--help"])\nexcept SystemExit: pass\n'
             'print([m for m in ("numpy", "scipy", "rosbags", "pyproj", "yaml", "rclpy") '
             'if m in sys.modules], file=sys.stderr)')
    done = subprocess.run([sys.executable, '-c', probe], capture_output=True, text=True,
                          check=True)
    assert done.stderr.strip() == '[]'


def test_the_package_run_as_a_module_is_the_command():
    result = subprocess.run([sys.executable, '-m', 'odocal_ros', '--version'], text=True,
                            capture_output=True, check=True)
    assert result.stdout == f'odocal_ros {__version__}\n'


@pytest.mark.parametrize('argv', [['paper'], ['patent', '--json'], ['paper', '--help']])
def test_a_command_of_a_package_that_is_not_installed_names_what_to_install(
        argv, monkeypatch, capsys):
    assert set(cli.COMMANDS) - set(OWN) == {'paper', 'patent'}
    monkeypatch.setattr('importlib.metadata.entry_points', lambda **asked: [])
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err == (f'odocal: {argv[0]} is a command of odocal_reproductions, which is not '
                   'installed; install it from a checkout of odocal_ros: '
                   'pip install ./reproductions\n')
