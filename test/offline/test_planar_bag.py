# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bag without an IMU: inspect finds nothing missing, try calibrates it."""

import json

import pytest

from odocal_ros.offline import cli


@pytest.fixture
def bag(tmp_path, monkeypatch):
    """Return the name of a bag of a robot with two wheels and motion capture."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(['simulate', '--scenario', 'indoor', '--duration', '90', '--no-imu',
                     '--reference', 'mocap', '--fix-rate', '10', '--out', 'robot',
                     '--quiet']) == 0
    return 'robot'


def test_inspect_suggests_a_replay_without_an_imu(bag, capfd):
    capfd.readouterr()
    assert cli.main(['inspect', bag, '--json']) == 0
    found = json.loads(capfd.readouterr()[0])
    assert 'NO_IMU' not in {reason['code'] for reason in found['findings']}
    assert '--set odometer.left=topic' in found['command']
    assert 'imu' not in found['command']


def test_try_calibrates_it(bag, capfd):
    assert cli.main(['try', bag, '--no-browser']) == 0
    out, _ = capfd.readouterr()
    assert 'track width' in out
    assert 'yaw mounting' not in out
