# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Result folders that are read-only, and nodes that end: complete files."""

import json
from pathlib import Path
import signal
import time

from bench import wait_for
from kills import drive, killed_at_files, LAST_S, SCALE, START_S, whole_content, wrong
import numpy as np
from player import Drive, messages_of, within
import pytest

from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
SPEED = 30.0
QUICK = {'method': 'two_point'}     # the files are the same
OBEY = (f'import sys; sys.path.insert(0, {str(Path(__file__).resolve().parents[1])!r})\n'
        'from disk_errors import obey_permissions; obey_permissions()\n')
# a report that takes as long as that of a long leg on a busy machine
SLOW = ('import odocal_ros.output.files as f\n'
        'draw = f.report_or_error_page\n'
        'f.report_or_error_page = lambda *a: [draw(*a) for _ in range(60)][-1]\n')


@pytest.fixture(scope='module')
def driven():
    return drive()


def drive_leg(driven, node, client):
    drive = Drive(node, client, driven, SPEED)
    drive.record(30, START_S, LAST_S)
    answer = drive.ended(LAST_S)
    assert answer.success, answer.message


def true(content):
    return within(content['result']['scale_factor'], SCALE, 5)


def results(folder):
    return [path for path in folder.iterdir() if path.name != 'journal' and not path.is_symlink()]


def test_a_read_only_folder_is_reported_and_used_once_it_is_writable(
        start, connect, driven, tmp_path):
    folder = tmp_path / 'shut'
    folder.mkdir()
    folder.chmod(0o555)
    node = start({'output.directory': folder} | QUICK, before=OBEY)
    client = connect()
    drive_leg(driven, node, client)
    status = wait_for(lambda: client.status['save_error'] and client.status, 'the warning')
    assert 'Permission denied' in status['save_error']
    assert str(folder) in status['save_error']
    assert 'Permission denied' in status['journal_error']
    assert 'output.directory' in status['journal_error']
    assert status['level'] == b'\x01'
    for words in ('the journal cannot be written: ', 'the result is not saved: '):
        assert words in status['message']
    assert node.text.count('the journal cannot be written') == 1
    assert abs(float(status['scale_factor']) - SCALE) < 5 * float(status['scale_factor_sigma'])
    assert not client.call('save').success
    assert list(folder.iterdir()) == []
    # no warning if no journal is required
    assert client.set(journal__max_bytes=0).successful
    client.until(journal='', journal_error='')
    folder.chmod(0o755)
    answer = client.call('save')
    assert answer.success, answer.message
    one, = results(folder)
    assert true(whole_content(one))
    assert (folder / 'latest').resolve() == one
    assert client.until(save_error='')['saved'] == str(one)
    # the folder of the next save can be set after the leg, too
    assert client.set(output__directory=str(tmp_path / 'other')).successful
    answer = client.call('save')
    assert answer.success, answer.message
    other, = results(tmp_path / 'other')
    assert true(whole_content(other))
    assert len(results(folder)) == 1
    assert node.process.poll() is None


@pytest.fixture(scope='module')
def sent():
    return messages_of(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=25.0, odometer_rate=11.0, fix_noise='rtk',
        odometer='speed', heading=0.7)))


@pytest.mark.parametrize(('how', 'before'), [
    (signal.SIGINT, ''), (signal.SIGTERM, SLOW)])
def test_a_signal_right_after_a_leg_ends_the_node_with_complete_files(
        play_to, sent, tmp_path, how, before):
    leg = play_to(sent, QUICK | {
        'alignment.heading_source': 'fixed', 'alignment.heading': 0.7,
        'output.formats': '[params, report]'}, SPEED, before=before)
    leg.record(40, 60, 115)
    answer, node = leg.ended(115), leg.node
    assert answer.success, answer.message
    if before:      # the numbers are written, the report is being drawn
        wait_for(lambda: list(tmp_path.glob('2*/calibration.json')), 'the numbers')
    began = time.monotonic()
    assert node.end(how) == 0
    assert time.monotonic() - began < 5.0 + 5.0      # timeout of launch; margin if busy
    assert 'terminate' not in node.text
    folder, = tmp_path.glob('2*')
    assert json.loads((folder / 'calibration.json').read_text())['verdict'] != 'rejected'
    assert (folder / 'calibration.yaml').exists()
    assert (folder / 'report.html').exists() == (not before)
    assert not list(tmp_path.rglob('.*.part'))


@pytest.mark.parametrize(('stage', 'moment_s'), [
    *(('stop', m) for m in np.random.default_rng(12).uniform(0.0, 4.0, 2).round(3)),
    *(('save', m) for m in np.random.default_rng(13).uniform(0.0, 0.4, 2).round(3))])
def test_a_node_killed_while_writing_leaves_complete_results(driven, tmp_path, stage, moment_s):
    left = killed_at_files(driven, stage, moment_s, tmp_path, **QUICK)
    assert left.half == []
    assert left.latest
    code, result, stderr = left.journal
    assert code in (0, 1), stderr
    assert result is not None
    assert wrong(left) == []
