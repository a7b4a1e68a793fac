# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A signal right after a good leg, while its files are written and its report is drawn."""

import json
import signal
import time

from bench import wait_for
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
    """Return types and messages of a drive."""
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
