# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults that are not the user's: one line, a file for who mends it, what is left of the leg."""

import errno
import os
from pathlib import Path
import subprocess
import sys

import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline.cli import main
from odocal_ros.pipeline import methods as leg_methods
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import simulate


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    made = simulate(SimOptions(scenario='town', duration=140.0, imu_rate=50.0))
    return write_bag(tmp_path_factory.mktemp('bag') / 'bag', drive_topics(made))


def test_a_method_that_breaks_leaves_a_trace_file(bag, tmp_path, monkeypatch, capsys):
    def breaks(prepared, passed):
        raise ZeroDivisionError('by nothing')
    monkeypatch.setitem(leg_methods.METHODS, 'smoother', breaks)
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    code = main(['replay', str(bag), '--output', str(tmp_path / 'out'), '--quiet', '--set',
                 'output.formats=[params]'])
    line, = capsys.readouterr().err.strip().splitlines()
    assert code in (0, 1)
    assert line.startswith('odocal: method smoother failed with an internal error; please report '
                           'it with ')
    trace = Path(line.split()[-1]).read_text()
    assert 'ZeroDivisionError: by nothing' in trace
    assert 'in breaks' in trace


def test_a_disk_that_cannot_give_a_page(bag, monkeypatch, capsys):
    given, count = os.pread, [0]

    def pread(handle, size, at):
        count[0] += 1
        if count[0] > 5:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return given(handle, size, at)
    monkeypatch.setattr(os, 'pread', pread)
    assert main(['inspect', str(bag)]) == 2
    error, = capsys.readouterr().err.strip().splitlines()
    assert error == f'odocal: {bag}/bag.mcap: Input/output error'


def test_memory_that_runs_out_is_called_so(bag):
    """Not an empty bag, not a damaged one: the limit of the process is met while it is read."""
    script = ('import resource, sys\n'
              'from odocal_ros.offline.cli import main\n'
              'import odocal_ros.bagio.mcap_file as m, odocal_ros.offline.inspect_bag\n'
              'given = m.McapFile._entries\n'
              'def entries(self, records, cut):\n'
              '    raise MemoryError\n'
              'm.McapFile._entries = entries\n'
              f'sys.exit(main(["inspect", {str(bag)!r}]))\n')
    ran = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                         check=False)
    assert ran.returncode == 2
    assert ran.stderr.startswith('odocal: out of memory')
