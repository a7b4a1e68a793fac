# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal doctor: it shows what is there, and of the environment only what it names."""

from importlib.metadata import version
import shutil
import sys

import pytest

from odocal_ros import __version__
from odocal_ros.offline import doctor
from odocal_ros.offline.cli import main

pytestmark = pytest.mark.core


def shown(capsys):
    code = main(['doctor'])
    rows = dict(line.split('  ', 1) for line in capsys.readouterr().out.splitlines()[:-1])
    return code, {name: text.strip() for name, text in rows.items()}


def test_what_is_installed_is_shown(capsys, tmp_path, monkeypatch):
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


def test_what_is_lacking_is_named(capsys, monkeypatch):
    monkeypatch.setattr(doctor, 'NEEDED', ('numpy', 'no-such-thing'))
    assert main(['doctor']) == 1
    assert 'missing: no-such-thing' in capsys.readouterr().out
