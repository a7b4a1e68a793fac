# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The line that tells what a command is at: on a terminal, and nowhere else."""

import os
import pty
import subprocess
import sys

import pytest

pytestmark = pytest.mark.core
CODE = """
from odocal_ros.offline.say import Phase
with Phase('reading town', quiet={quiet}) as phase:
    phase(0.25)
    phase(0.5, 'leg 2 of 2')
    phase(None, 'smoother, 7 passes done')
with Phase('drawing the report'):
    pass
print('the result')
"""


def run(quiet=False):
    """Return what goes to the output, and to the error stream, which is a terminal."""
    master, slave = pty.openpty()
    child = subprocess.Popen([sys.executable, '-c', CODE.format(quiet=quiet)], text=True,
                             stdout=subprocess.PIPE, stderr=slave)
    os.close(slave)
    told = b''
    try:
        while chunk := os.read(master, 65536):
            told += chunk
    except OSError:      # the other side is closed
        pass
    os.close(master)
    out, _ = child.communicate(timeout=60)
    assert child.returncode == 0, told
    return out, told.decode()


def test_a_terminal_shows_each_phase_and_is_left_clean():
    out, told = run()
    assert out == 'the result\n'
    for part in ('reading town', '25 %', 'leg 2 of 2', '50 %', 'drawing the report'):
        assert part in told, part
    *_, last = (line for line in told.split('\r') if 'smoother' in line)
    assert '%' not in last
    assert told.split('\r')[-1].strip() == ''      # the line is wiped
    assert '\n' not in told.replace('\r\n', '')


def test_quiet_is_quiet_and_a_pipe_stays_clean():
    assert run(quiet=True)[1].count('reading') == 0
    # a file or pipe as the error stream gets nothing at all
    done = subprocess.run([sys.executable, '-c', CODE.format(quiet=False)], text=True,
                          capture_output=True, timeout=60)
    assert (done.stdout, done.stderr) == ('the result\n', '')
