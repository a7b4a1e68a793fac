# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A node ended by a signal or a kill while it computes, writes, draws: whole results or none."""

import json
import signal
import time

from bench import wait_for
from kills import drive, killed_at_files, wrong
import numpy as np
from player import ended, messages_of, part, recording
import pytest

from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
# a report that takes as long as that of a long leg on a busy machine
SLOW = ('import odocal_ros.output.files as f\n'
        'draw = f.report_or_why\n'
        'f.report_or_why = lambda *a: [draw(*a) for _ in range(60)][-1]\n')


@pytest.fixture(scope='module')
def sent():
    return messages_of(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=25.0, odometer_rate=11.0, fix_noise='rtk',
        odometer='speed', heading=0.7)))


@pytest.mark.parametrize(('how', 'before'), [
    (signal.SIGINT, ''), (signal.SIGTERM, SLOW)])
def test_a_signal_right_after_a_leg_ends_well_with_whole_files(
        start, connect, sent, tmp_path, how, before):
    node = start('-p', 'alignment.heading_source:=fixed', '-p', 'alignment.heading:=0.7',
                 '-p', 'method:=two_point', '-p', 'output.formats:=[params, report]',
                 before=before)
    client = connect()
    player = recording(client, sent, 40, 60, 30)
    player.play(part(sent[1], 60, 115), 30)
    answer = ended(client, player, part(sent[1], 115, 117), 30)
    assert answer.success, answer.message
    if before:      # the numbers are there, the report is being drawn
        wait_for(lambda: list(tmp_path.glob('2*/calibration.json')), 'the numbers')
    began = time.monotonic()
    assert node.end(how) == 0
    assert time.monotonic() - began < 5.0 + 5.0      # launch's patience; ours of a busy machine
    assert 'terminate' not in node.text
    folder, = tmp_path.glob('2*')
    assert json.loads((folder / 'calibration.json').read_text())['verdict'] != 'rejected'
    assert (folder / 'calibration.yaml').exists()
    assert (folder / 'report.html').exists() == (not before)
    assert not list(tmp_path.rglob('.*.part'))


@pytest.fixture(scope='module')
def driven():
    return drive()


@pytest.mark.parametrize(('stage', 'moment_s'), [
    *(('stop', m) for m in np.random.default_rng(12).uniform(0.0, 4.0, 2).round(3)),
    *(('save', m) for m in np.random.default_rng(13).uniform(0.0, 0.4, 2).round(3))])
def test_a_node_killed_at_its_files_leaves_whole_ones(driven, tmp_path, stage, moment_s):
    # the quick method: the files are the same
    left = killed_at_files(driven, stage, moment_s, tmp_path, '-p', 'method:=two_point')
    assert left.half == []
    assert left.latest
    code, result, said = left.journal
    assert code in (0, 1), said
    assert result is not None
    assert wrong(left) == []
