# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Internal errors, failing hardware, and bags with hostile names: one-line errors and files."""

import errno
import json
import os
from pathlib import Path
import subprocess
import sys

from drives import drive
import pytest
import yaml

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline.cli import main
from odocal_ros.pipeline import methods as leg_methods
from odocal_ros.sim.scenarios import SimOptions, simulate

FRAME = "imu$(command 'touch ran')\x1b[2J\ntouch ran; `touch ran`"
FIX = '--fix-topic', '/fix'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    made = simulate(SimOptions(scenario='town', duration=140.0, imu_rate=50.0))
    return write_bag(tmp_path_factory.mktemp('bag') / 'bag', drive_topics(made))


def test_a_method_with_an_internal_error_leaves_a_trace_file(bag, tmp_path, monkeypatch, capsys):
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


def test_a_read_error_of_the_disk_is_reported_in_one_line(bag, monkeypatch, capsys):
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


def test_exhausted_memory_is_reported_as_such(bag):
    """The error is neither an empty nor a damaged bag: memory is exhausted during reading."""
    script = ('import resource, sys\n'
              'from odocal_ros.offline.cli import main\n'
              'import odocal_ros.bagio.mcap_file as m, odocal_ros.offline.inspect_bag\n'
              'def read_chunk(self, index):\n'
              '    raise MemoryError\n'
              'assert m.McapFile._read_chunk\n'
              'm.McapFile._read_chunk = read_chunk\n'
              f'sys.exit(main(["inspect", {str(bag)!r}]))\n')
    ran = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                         check=False)
    assert ran.returncode == 2
    assert ran.stderr.startswith('odocal: out of memory')


@pytest.fixture(scope='module')
def evil(tmp_path_factory):
    """Write a drive whose IMU frame, folder name and one more topic are commands."""
    made = drive(scenario='straight', duration=200.0, imu_grade='tactical')
    topics = [t for t in drive_topics(made) if t.name != '/imu/data']
    return write_bag(tmp_path_factory.mktemp('evil') / 'drive\ntouch ran: \x1b[2J',
                     [encode.imu('/imu/data', made.imu, FRAME), *topics,
                      encode.fix('/a\ntouch ran\x1b[2J', made.fix)])


def test_replay_escapes_hostile_names_in_output_and_files(evil, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['replay', str(evil), *FIX, '--set', 'alignment.heading=0.7', '--set',
                 'output.formats=[params, autoware, transform, track, legs]']) in (0, 1)
    out, err = capsys.readouterr()
    folder, = tmp_path.iterdir()
    assert folder.name.isprintable()
    content = json.loads((folder / 'calibration.json').read_text())
    assert 'FRAME_REPLACED' in {r['code'] for r in content['reasons']}
    assert content['config']['frames.imu'] == 'imu_link'
    for text in (out, err, *(p.read_text() for p in folder.iterdir())):
        assert text.replace('\n', '').isprintable()
        assert not [x for x in text.splitlines() if x.startswith('touch')]
    result = yaml.safe_load((folder / 'calibration.yaml').read_text())
    assert list(result) == ['/**']


def test_errors_with_hostile_names_are_one_line(evil, tmp_path, capsys):
    for argv in (['replay', str(evil)], ['replay', str(evil), *FIX, '--imu-topic', '/no\x1b[2J'],
                 ['replay', str(evil.parent / 'no\nsuch\x1b[2J')],
                 ['inspect', str(evil / 'x\ny')]):
        assert main(argv) == 2
        out, err = capsys.readouterr()
        assert out == ''
        first, *listed = err.splitlines()      # topics of the bag, one per line
        assert first.startswith('odocal: ')
        assert all(line.startswith('  /') for line in listed)
        assert err.replace('\n', '').isprintable()
    assert main(['inspect', str(evil)]) == 0
    out = capsys.readouterr().out
    assert out.replace('\n', '').isprintable()
    assert not [line for line in out.splitlines() if line.startswith('touch ran\\x1b')]
    assert '/a\\ntouch ran' in out


def test_a_journal_with_a_hostile_frame_is_refused_in_one_line(evil, tmp_path, capsys):
    (evil / 'journal.yaml').write_text(
        '/**:\n  ros__parameters:\n    frames.imu: "x$(command y)"\n')
    try:
        assert main(['replay', str(evil), *FIX, '--output', str(tmp_path / 'o')]) == 2
    finally:
        (evil / 'journal.yaml').unlink()
    assert 'is not a frame name' in capsys.readouterr().err
